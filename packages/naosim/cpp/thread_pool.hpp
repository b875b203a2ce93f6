// Threads that stay alive between rounds of work.
#pragma once
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>
#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace naosim {

// What another module needs to work on a pool's threads; its address is handed over as a number.
struct Threads {
  void* pool;
  void (*run)(void* pool, int count, void (*job)(void* context, int index), void* context);
};

// Runs a job for every index with the calling thread and `threads - 1` helpers.
//
// A round takes microseconds and the next one follows soon, so a waiting thread looks for the event for a moment before it sleeps: to be
// woken up takes as long as a round. With fewer processors than threads it sleeps at once.
class ThreadPool {
 public:
  explicit ThreadPool(int threads) : spins_(static_cast<int>(std::thread::hardware_concurrency()) >= threads) {
    for (int k = 1; k < threads; ++k) helpers_.emplace_back([this] { help(); });
  }

  ~ThreadPool() {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      stop_ = true;
    }
    start_.notify_all();
    for (auto& helper : helpers_) helper.join();
  }

  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;

  // One caller at a time. A job must not throw.
  void run(int count, const std::function<void(int)>& job) {
    if (helpers_.empty() || count < 2) {
      for (int k = 0; k < count; ++k) job(k);
      return;
    }
    job_ = &job;
    count_ = count;
    next_ = 0;
    busy_ = static_cast<int>(helpers_.size());
    bool asleep;
    {
      std::lock_guard<std::mutex> lock(mutex_);
      ++round_;
      asleep = sleepers_ > 0;
    }
    if (asleep) start_.notify_all();
    work();
    const auto finished = [&] { return busy_ == 0; };
    if (spin(finished)) return;
    std::unique_lock<std::mutex> lock(mutex_);
    done_.wait(lock, finished);
  }

  // For work of others between rounds; nullptr if there are no helpers.
  const Threads* table() const { return helpers_.empty() ? nullptr : &table_; }

 private:
  static constexpr std::chrono::microseconds kSpin{100};

  // Return whether the event came while this thread looked for it.
  template <class Event>
  bool spin(Event event) const {
    if (!spins_) return event();
    const auto end = std::chrono::steady_clock::now() + kSpin;
    do {
      for (int k = 0; k < 64; ++k) {
        if (event()) return true;
#if defined(__x86_64__)
        _mm_pause();
#endif
      }
    } while (std::chrono::steady_clock::now() < end);
    return false;
  }

  void work() {
    for (int k = next_.fetch_add(1); k < count_; k = next_.fetch_add(1)) (*job_)(k);
  }

  void help() {
    std::uint64_t seen = 0;
    const auto called = [&] { return stop_ || round_ != seen; };
    for (;;) {
      if (!spin(called)) {
        std::unique_lock<std::mutex> lock(mutex_);
        ++sleepers_;
        start_.wait(lock, called);
        --sleepers_;
      }
      if (stop_) return;
      seen = round_;
      work();
      if (busy_.fetch_sub(1) == 1) {
        // locked, so that the caller cannot fall asleep between its check and this
        std::lock_guard<std::mutex> lock(mutex_);
        done_.notify_one();
      }
    }
  }

  static void run_plain(void* pool, int count, void (*job)(void*, int), void* context) {
    static_cast<ThreadPool*>(pool)->run(count, [=](int index) { job(context, index); });
  }

  const bool spins_;
  const Threads table_{this, run_plain};
  std::mutex mutex_;
  std::condition_variable start_, done_;
  const std::function<void(int)>* job_ = nullptr;
  std::atomic<int> next_{0}, busy_{0};
  int count_ = 0, sleepers_ = 0;
  std::atomic<std::uint64_t> round_{0};
  std::atomic<bool> stop_{false};
  std::vector<std::thread> helpers_;  // last: they use the rest
};

}  // namespace naosim
