// Outputs of networks of tanh layers; naosprint.rl.forward documents the arguments.
//
// Every output is one sum over the inputs in their order, beginning with the bias, in single precision and without fused
// operations. So the bits do not depend on the instruction set, the number of rows, the number of threads, or the compiler.
#pragma once
#include <string>
#include <vector>

namespace naosprint {

// A layer computes outputs = inputs * weight^T + bias. weight is (outputs, inputs), row by row.
struct DenseLayer {
  int inputs, outputs;
  const float *weight, *bias;
};

// Weights in the layout of the products: (inputs, padded outputs), then the padded bias.
struct PackedLayer {
  int inputs, outputs, padded;
  std::vector<float> weight, bias;
};

constexpr int kForwardRows = 16;  // rows that pass through the network together
constexpr int kForwardPad = 16;   // outputs are padded to a multiple, for every instruction set alike

// Compute up to kForwardRows rows. `added`, if given, is added to the outputs. The scratch memory has room for 2 * kForwardRows rows of
// the widest layer.
using ForwardRows = void (*)(const std::vector<PackedLayer>& layers, const float* inputs, const float* added, float* outputs, int rows,
                             float* scratch);

struct ForwardKernel {
  const char* name;
  ForwardRows run;
};

}  // namespace naosprint
