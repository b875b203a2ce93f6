// The step of Adam (Kingma and Ba, 2015) after clipping of the gradient's norm; naosprint.rl.adam documents the arguments.
//
// The bits are those of PyTorch's functions on x86-64 with AVX2 or AVX-512, on every processor: sums of squares have eight partial sums,
// and the same operations are fused. So trainings do not depend on which of them PyTorch chooses.
#pragma once
#include <cstddef>
#include <vector>

namespace naosprint {

// Arrays of one parameter with `size` numbers; `step` counts its steps.
struct Slot {
  float *parameter, *gradient, *mean, *square, *step;
  std::size_t size;
};

struct AdamKernel {
  const char* name;
  // Multiply the gradients by min(1, most / norm), where norm is that of all of them together.
  void (*clip)(const std::vector<Slot>& slots, float most);
  // m <- m + (1 - b1) (g - m), v <- b2 v + (1 - b2) g^2, p <- p - rate m / (1 - b1^t) / (sqrt(v / (1 - b2^t)) + epsilon)
  void (*step)(const std::vector<Slot>& slots, double rate, double epsilon);
};

}  // namespace naosprint
