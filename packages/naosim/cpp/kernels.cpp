// Chooses the kernel for the processor the program runs on.
#include "group.hpp"
#include "instruction_sets.hpp"

namespace naosim {

NAOSIM_KERNELS(Kernel)

const Kernel& best_kernel() { return *choose(kKernels, nullptr); }
const Kernel* find_kernel(const char* name) { return choose(kKernels, name); }

}  // namespace naosim
