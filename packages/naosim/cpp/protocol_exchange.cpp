#include <charconv>
#include <limits>

#include "protocol.hpp"

namespace naosim::protocol {

SparkExchange::SparkExchange(int n, std::vector<std::string> joints, std::vector<std::string> effectors,
                             std::vector<std::string> landmarks)
    : Exchange(n),
      joints_(joints.size()),
      sights_(3 * landmarks.size()),
      openings_(std::move(effectors)),
      reader_(joints, landmarks),
      robots_(static_cast<std::size_t>(n)) {
  for (std::string& opening : openings_) opening = '(' + opening + ' ';
  const std::size_t rows = static_cast<std::size_t>(n);
  joint_angles.assign(rows * joints_, 0.0);
  gyro.assign(rows * 3, 0.0);
  accel.assign(rows * 3, 0.0);
  for (auto& sensor : touch) sensor.assign(rows * 6, std::numeric_limits<double>::quiet_NaN());
  time.assign(rows, 0.0);
  game_time.assign(rows, 0.0);
  torso_position.assign(rows * 3, 0.0);
  torso_rotation.assign(rows * 9, 0.0);
  ball.assign(rows * 3, 0.0);
  vision.assign(rows * sights_, std::numeric_limits<double>::quiet_NaN());
}

void SparkExchange::choose(int row, int side, int uniform_number) {
  robots_[row].side = side;
  robots_[row].uniform_number = uniform_number;
}

void SparkExchange::clear(int row) { robots_[row] = Robot(); }

void SparkExchange::compose(int, const double* speeds, std::string& message) {
  for (std::size_t j = 0; j < joints_; ++j) {
    // the shortest text that the server reads as the same single-precision number
    char text[64];
    char* end = std::to_chars(text, text + sizeof text - 1, static_cast<float>(speeds[j]), std::chars_format::fixed).ptr;
    *end++ = ')';
    message += openings_[j];
    message.append(text, end);
  }
  message += "(syn)";
}

std::string SparkExchange::read(int row, bool monitor, std::string_view text) {
  const std::size_t r = static_cast<std::size_t>(row);
  Robot& robot = robots_[row];
  if (!monitor) {
    const PerceptorTargets to{&joint_angles[r * joints_], &gyro[3 * r], &accel[3 * r],
                      {&touch[0][6 * r], &touch[1][6 * r], &touch[2][6 * r], &touch[3][6 * r]}, &time[r], &game_time[r],
                      vision.data() + sights_ * r};
    return reader_.read(text, to, robot.game, robot.joints_seen);
  }
  const std::string problem = robot.scene.read(text);
  if (problem.empty()) {
    robot.torso_seen = robot.scene.torso(robot.side, robot.uniform_number, &torso_position[3 * r], &torso_rotation[9 * r]);
    robot.scene.ball(&ball[3 * r]);
  }
  return problem;
}

std::string SparkExchange::lacking(int row) const {
  const int seen = robots_[row].joints_seen;
  const std::size_t r = static_cast<std::size_t>(row);
  const bool whole = finite(&joint_angles[r * joints_], joints_) && finite(&gyro[3 * r], 3) && finite(&accel[3 * r], 3) &&
                     finite(&torso_position[3 * r], 3) && finite(&torso_rotation[9 * r], 9);
  if (!whole) return kNotFinite;
  if (seen == static_cast<int>(joints_)) return {};
  return std::to_string(seen) + " of " + std::to_string(joints_) + " joint angles came";
}

}  // namespace naosim::protocol
