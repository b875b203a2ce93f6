// Gradients of PPO's two losses for a network of tanh layers; naosprint.rl.gradients documents the arguments.
//
// Where networks are symmetric, vectors are computed as two halves: the even one has the sums of the pairs that mirroring
// exchanges, and what it leaves as it is, the odd one has the pairs' differences, and what changes its sign. A symmetric layer maps
// even numbers to even ones and odd to odd, so that its products are two of half the size, a quarter each.
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

// Left-right mirror of a vector: it exchanges the pairs and multiplies each by its sign; `odd` changes its sign, `even` does not change.
struct Mirror {
  struct Pair {
    int left, right;
    float sign;
  };
  std::vector<Pair> pairs;
  std::vector<int> even, odd;
};

// Rows of the rollout that form the minibatch.
struct Rows {
  const std::int64_t* index;
  int count;
};

// `targets` are what outputs should be: returns for a critic, demonstrated actions for an actor that imitates.
struct Rollout {
  const float *observations, *actions, *log_probs, *advantages, *targets;
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

// A network's layers, and mirrors of its inputs and of each layer's outputs if it is symmetric, otherwise none. Mirrored weights must be
// equal; their gradients are the means of both. Hidden layers have pairs of sign 1 only.
struct Network {
  std::vector<Layer> layers;
  std::vector<Mirror> mirrors;
};

// Write the (count, width) rows as halves: even numbers first, in the order of the pairs, then odd ones.
void split(const Mirror& mirror, const float* rows, std::int64_t count, float* halves);

struct Kernel {
  const char* name;
  // Observations of a symmetric network are halves.
  // Mean of -min(advantage * ratio, advantage * clipped ratio); the gradient of log_std is added up in log_std_gradient if given.
  ActorResult (*actor)(const Network& network, const float* log_std, float* log_std_gradient, const Rollout& rollout, const Rows& rows,
                       bool normalize_advantages, float clip_range, Workspace& workspace);
  // coefficient * mean squared error of all outputs; returns the mean squared error.
  double (*squared)(const Network& network, const Rollout& rollout, const Rows& rows, float coefficient, Workspace& workspace);
};

const Kernel& best_kernel();
const Kernel* find_kernel(const char* name);  // nullptr if the processor does not support it

}  // namespace naosprint
