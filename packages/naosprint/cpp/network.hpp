// Gradients of PPO's two losses for a network of tanh layers; naosprint.rl.gradients documents the arguments.
//
// A minibatch passes forward and backward in tiles of rows that stay in the processor's cache. Every number is computed by
// one sequence of operations, whatever the width of the registers: results do not depend on the instruction set, as long as
// it has a fused multiply-add, nor on the number of threads.
#pragma once
#include <cstdint>
#include <vector>

namespace naosprint {

// A layer computes outputs = inputs * weight^T + bias. weight is (outputs, inputs), row by row.
struct Layer {
  int inputs, outputs;
  const float *weight, *bias;
  float *weight_gradient, *bias_gradient;
};

// Rows of the rollout that form the minibatch.
struct Rows {
  const std::int64_t* index;
  int count;
};

struct Rollout {
  const float *observations, *actions, *log_probs, *advantages, *returns;
};

struct ActorResult {
  double loss, clipped, kl;
};

// Scratch memory of a kernel; it grows to the largest network used.
class Workspace {
 public:
  float* take(std::size_t floats);
  void begin() { used_ = 0; }
  void reserve(std::size_t floats);

 private:
  std::vector<float> memory_;
  std::size_t used_ = 0;
};

struct Kernel {
  const char* name;
  // Mean of -min(advantage * ratio, advantage * clipped ratio); the gradient of log_std is added up in log_std_gradient if given.
  ActorResult (*actor)(const std::vector<Layer>& layers, const float* log_std, float* log_std_gradient, const Rollout& rollout, const Rows& rows,
                       bool normalize_advantages, float clip_range, Workspace& workspace);
  // coefficient * mean squared error; returns the mean squared error.
  double (*critic)(const std::vector<Layer>& layers, const Rollout& rollout, const Rows& rows, float coefficient, Workspace& workspace);
};

const Kernel& best_kernel();
const Kernel* find_kernel(const char* name);  // nullptr if the processor does not support it

}  // namespace naosprint
