// A task's step for n robots: measurements, observations, rewards and ends; naosprint.tasks.environment has the same in Python.
#pragma once
#include <cstdint>
#include <memory>
#include <vector>

#include "operations.hpp"

namespace naosprint {

class Program {
 public:
  struct Block {
    std::shared_ptr<Operation> operation;
    int first;     // column of the observation
    bool rates;    // rates follow
    bool angular;  // whose rates take the short way round
    int value;     // column of `values`, if rates follow
  };
  struct Term {
    std::shared_ptr<Operation> operation;
    double weight;
  };
  struct End {
    Table<bool> flag, reached;  // the task's and the environment's
    bool failure;
  };
  // An action as a joint's target angle: (action + 1) * factor + low, or, limited to [low, high], centre + action * factor, all times sign.
  struct Joint {
    int index;
    double factor, low, high, centre, sign;
  };
  // The environment's arrays, one row per robot.
  struct Arrays {
    Table<double> observations, values, rewards, actions, previous_actions, targets;
    Table<std::int64_t> steps;
    Table<bool> terminated, truncated, failed, lost, short_episode;
  };

  std::vector<std::shared_ptr<Operation>> measurements;
  std::vector<Block> blocks;
  std::vector<Term> terms;
  std::vector<End> ends;
  std::vector<Joint> joints;
  bool around_nominal = false;
  std::vector<double> nominal;  // target angles of joints that no action moves
  Arrays arrays;
  double scale = 1.0;
  // Observations of a policy at one step, and at all that it sees: those of earlier steps follow, the latest first. Those of a critic are last.
  int width = 0, seen = 0;

  // When episodes end by their length.
  struct Limits {
    std::int64_t max_steps, short_steps;
    bool horizon_is_terminal;
  };

  // Store and clip (count, A) actions of robots, and compute their targets.
  template <class Number>
  void act(std::int64_t first, int count, const Number* given) const {
    for (int k = 0; k < count; ++k) {
      const std::int64_t row = first + k;
      double *action = arrays.actions[row], *previous = arrays.previous_actions[row], *target = arrays.targets[row];
      for (std::size_t j = 0; j < nominal.size(); ++j) target[j] = nominal[j];
      for (std::size_t j = 0; j < joints.size(); ++j) {
        const Joint& joint = joints[j];
        previous[j] = action[j];
        const double unit = clipped(static_cast<double>(*given++), -1.0, 1.0);
        action[j] = unit;
        target[joint.index] =
            around_nominal ? clipped(joint.centre + unit * joint.factor, joint.low, joint.high) * joint.sign : (unit + 1.0) * joint.factor + joint.low;
      }
    }
  }
  // Finish a step of robots that the simulator has stepped. `lost`: (count,), or nullptr.
  void step(std::int64_t first, int count, const bool* lost, const Limits& limits, std::uint64_t threads) const;
  // Episodes of robots begin.
  void begin(const Rows& rows) const;

 private:
  static double clipped(double value, double low, double high) { return value < low ? low : value > high ? high : value; }
  void step_rows(const Rows& rows, const bool* lost, const Limits& limits) const;
};

}  // namespace naosprint
