// Threads that another module's simulator keeps, for work between its steps. naosim's thread_pool.hpp has the same table.
#pragma once
#include <cstdint>
#include <type_traits>

namespace naosprint {

struct Threads {
  void* pool;
  void (*run)(void* pool, int count, void (*job)(void* context, int index), void* context);
};

// Run job(0) to job(count - 1), on the threads at this address if there are any.
template <class Job>
void run_on(std::uint64_t address, int count, Job&& job) {
  if (address == 0 || count < 2) {
    for (int index = 0; index < count; ++index) job(index);
    return;
  }
  const Threads& threads = *reinterpret_cast<const Threads*>(static_cast<std::uintptr_t>(address));
  using Plain = std::remove_reference_t<Job>;
  threads.run(threads.pool, count, [](void* context, int index) { (*static_cast<Plain*>(context))(index); }, &job);
}

}  // namespace naosprint
