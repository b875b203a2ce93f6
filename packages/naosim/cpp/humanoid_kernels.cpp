// Chooses the kernel for a robot and for the processor the program runs on.
#include "humanoid.hpp"
#include "instruction_sets.hpp"

namespace naosim {
namespace t1 {
NAOSIM_KERNELS(humanoid::Kernel)
}
namespace k1 {
NAOSIM_KERNELS(humanoid::Kernel)
}

namespace humanoid {
const Kernel* find_kernel(const char* robot, const char* isa) {
  if (std::strcmp(robot, "t1") == 0) return choose(t1::kKernels, isa);
  if (std::strcmp(robot, "k1") == 0) return choose(k1::kKernels, isa);
  return nullptr;
}
}  // namespace humanoid
}  // namespace naosim
