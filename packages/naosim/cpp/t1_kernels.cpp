// Chooses the T1's kernel for the processor the program runs on.
#include <cstring>

#include "t1_model.hpp"

namespace naosim::t1 {
namespace generic {
extern const Kernel kernel;
}
#ifdef NAOSIM_HAS_avx2
namespace avx2 {
extern const Kernel kernel;
}
#endif
#ifdef NAOSIM_HAS_avx512
namespace avx512 {
extern const Kernel kernel;
}
#endif

namespace {
bool runs_here(const Kernel& kernel) {
#if defined(__x86_64__)
  if (std::strcmp(kernel.name, "avx512") == 0)
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw") &&
           __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512cd");
  if (std::strcmp(kernel.name, "avx2") == 0)
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
#endif
  return std::strcmp(kernel.name, "generic") == 0;
}
const Kernel* const kKernels[] = {
#ifdef NAOSIM_HAS_avx512
    &avx512::kernel,
#endif
#ifdef NAOSIM_HAS_avx2
    &avx2::kernel,
#endif
    &generic::kernel,
};
}  // namespace

const Kernel* find_kernel(const char* name) {
  for (const Kernel* kernel : kKernels)
    if ((name == nullptr || std::strcmp(kernel->name, name) == 0) && runs_here(*kernel)) return kernel;
  return nullptr;
}

const Kernel& best_kernel() { return *find_kernel(nullptr); }

}  // namespace naosim::t1
