// The exchange with rcssservermj: the agent port of one server a robot. The monitor port is used only before that, to
// enter the field.
#pragma once
#include <unordered_map>

#include "exchange.hpp"
#include "text.hpp"

namespace naosim::protocol {

class MujocoExchange final : public Exchange {
 public:
  // Names of joint perceptors and of effectors, and motor gains, one a joint; whether to read where the ball is seen.
  MujocoExchange(int n, const std::vector<std::string>& perceptors, const std::vector<std::string>& effectors, const std::vector<double>& kp,
                 const std::vector<double>& kd, bool ball);
  std::size_t joint_count() const { return joints_; }
  // Text that precedes the row's next command, for example a beam.
  void prepend(int row, std::string_view text) { robots_[row].ahead = text; }
  const std::string& play_mode(int row) const { return robots_[row].play_mode; }

  std::vector<double> joint_angles, joint_speeds, torso_quat, torso_pos, gyro, accel, ball, time, rotation;

 private:
  struct Robot {
    std::string play_mode, ahead;
    std::vector<double> commanded;  // degrees; NaN where none has been sent
    int parts_seen = 0;
  };
  void clear(int row) override;
  void compose(int row, const double* targets, std::string& message) override;  // (joints,) rad
  void compose_idle(int, std::string& message) override { message += "(syn)"; }
  std::string read(int row, bool monitor, std::string_view text) override;
  std::string lacking(int row) const override;
  std::size_t joints_;
  bool sees_ball_;
  std::vector<std::string> names_, heads_, tails_;  // of the perceptors; of a command before and behind the angle
  std::unordered_map<std::string_view, int> index_;
  std::vector<Robot> robots_;
};

}  // namespace naosim::protocol
