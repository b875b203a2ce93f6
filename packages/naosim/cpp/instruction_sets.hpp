// Chooses among kernels compiled for several instruction sets; the best come first.
#pragma once
#include <cstddef>
#include <cstring>

namespace naosim {

inline bool runs_here(const char* isa) {
#if defined(__x86_64__)
  if (std::strcmp(isa, "avx512") == 0)
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw") &&
           __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512cd");
  if (std::strcmp(isa, "avx2") == 0) return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
#endif
  return std::strcmp(isa, "generic") == 0;
}

// The kernel of this name, or the best one that runs here if there is no name; null if none does.
template <class Kernel, std::size_t count>
const Kernel* choose(const Kernel* const (&kernels)[count], const char* name) {
  for (const Kernel* kernel : kernels)
    if ((name == nullptr || std::strcmp(kernel->name, name) == 0) && runs_here(kernel->name)) return kernel;
  return nullptr;
}

}  // namespace naosim

#ifdef NAOSIM_HAS_avx512
#define NAOSIM_IF_avx512(...) __VA_ARGS__
#else
#define NAOSIM_IF_avx512(...)
#endif
#ifdef NAOSIM_HAS_avx2
#define NAOSIM_IF_avx2(...) __VA_ARGS__
#else
#define NAOSIM_IF_avx2(...)
#endif
// Within a namespace: declares its kernels, and the table of those that were built.
#define NAOSIM_KERNELS(Kernel)                                     \
  namespace generic { extern const Kernel kernel; }                \
  NAOSIM_IF_avx2(namespace avx2 { extern const Kernel kernel; })     \
  NAOSIM_IF_avx512(namespace avx512 { extern const Kernel kernel; }) \
  inline const Kernel* const kKernels[] = {NAOSIM_IF_avx512(&avx512::kernel, ) NAOSIM_IF_avx2(&avx2::kernel, ) & generic::kernel};
