#include "mujoco_exchange.hpp"

#include <charconv>
#include <cmath>
#include <cstdio>
#include <limits>

#include "mujoco_units.hpp"

namespace naosim::protocol {

MujocoExchange::MujocoExchange(int n, const std::vector<std::string>& perceptors, const std::vector<std::string>& effectors,
                               const std::vector<double>& kp, const std::vector<double>& kd, bool ball)
    : Exchange(n), joints_(perceptors.size()), sees_ball_(ball), names_(perceptors), robots_(static_cast<std::size_t>(n)) {
  for (std::size_t j = 0; j < joints_; ++j) {
    index_.emplace(names_[j], static_cast<int>(j));
    heads_.push_back("(" + effectors[j] + " ");
    char tail[80];
    std::snprintf(tail, sizeof tail, " 0 %.12g %.12g 0)", kp[j], kd[j]);
    tails_.push_back(tail);
  }
  const std::size_t rows = static_cast<std::size_t>(n);
  joint_angles.assign(rows * joints_, 0.0);
  joint_speeds.assign(rows * joints_, 0.0);
  torso_quat.assign(rows * 4, 0.0);
  for (auto* triple : {&torso_pos, &gyro, &accel}) triple->assign(rows * 3, 0.0);
  this->ball.assign(rows * 3, std::numeric_limits<double>::quiet_NaN());
  time.assign(rows, 0.0);
  rotation.assign(rows * 9, 0.0);
  for (int row = 0; row < n; ++row) clear(row);
}

void MujocoExchange::clear(int row) {
  robots_[row] = Robot();
  robots_[row].commanded.assign(joints_, std::numeric_limits<double>::quiet_NaN());
}

void MujocoExchange::compose(int row, const double* targets, std::string& message) {
  Robot& robot = robots_[row];
  message += robot.ahead;
  robot.ahead.clear();
  const std::size_t empty = message.size();
  for (std::size_t j = 0; j < joints_; ++j) {
    const double degrees = mujoco::command_degrees(targets[j]);
    // Targets and gains persist. Every node costs the server 20 us, so unchanged ones are left out.
    if (degrees == robot.commanded[j]) continue;
    robot.commanded[j] = degrees;
    char text[64];
    const auto end = std::to_chars(text, text + sizeof text, degrees, std::chars_format::fixed);
    message += heads_[j];
    message.append(text, end.ptr);
    message += tails_[j];
  }
  if (message.size() == empty) message += "(syn)";
}

std::string MujocoExchange::read(int row, bool, std::string_view text) {
  const std::size_t r = static_cast<std::size_t>(row);
  Robot& robot = robots_[row];
  Cursor cursor(text);
  std::string_view tag, field, word;
  int seen = 0;
  const auto wrong = [&](const char* what) {
    return "agent message, byte " + std::to_string(cursor.offset()) + ": " + what + " cannot be read";
  };
  const auto numbers = [&](std::string_view name, double* values, int count) {
    while (cursor.enter(field)) {
      if (field == name) {
        if (!cursor.numbers(values, count)) return false;
        ++seen;
      }
      if (!cursor.leave()) return false;
    }
    return true;
  };
  for (std::size_t k = 0; k < 3; ++k) ball[3 * r + k] = std::numeric_limits<double>::quiet_NaN();
  while (!cursor.done()) {
    if (!cursor.enter(tag)) return wrong("an expression");
    if (tag == "HJ") {
      int joint = -1;
      double angle = 0, speed = 0;
      int found = 0;
      while (cursor.enter(field)) {
        if (field == "n" && cursor.atom(word)) {
          const auto at = index_.find(word);
          if (at != index_.end()) joint = at->second;
        } else if (field == "ax" || field == "vx") {
          if (!cursor.number(field == "ax" ? angle : speed)) return wrong("a joint");
          ++found;
        }
        if (!cursor.leave()) return wrong("HJ");
      }
      if (found != 2) return wrong("HJ");
      if (joint >= 0) {
        joint_angles[r * joints_ + joint] = angle;
        joint_speeds[r * joints_ + joint] = speed;
        ++seen;
      }
    } else if (tag == "time") {
      if (!numbers("now", &time[r], 1)) return wrong("time");
    } else if (tag == "quat") {
      if (!numbers("q", &torso_quat[4 * r], 4)) return wrong("quat");
    } else if (tag == "pos") {
      if (!numbers("p", &torso_pos[3 * r], 3)) return wrong("pos");
    } else if (tag == "GYR") {
      if (!numbers("rt", &gyro[3 * r], 3)) return wrong("GYR");
    } else if (tag == "ACC") {
      if (!numbers("a", &accel[3 * r], 3)) return wrong("ACC");
    } else if (tag == "See" && sees_ball_) {
      while (cursor.enter(field)) {
        if (field == "B" && !(cursor.enter(word) && cursor.numbers(&ball[3 * r], 3) && cursor.leave())) return wrong("See");
        if (!cursor.leave()) return wrong("See");
      }
    } else if (tag == "GS") {
      while (cursor.enter(field)) {
        if (field == "pm" && cursor.atom(word)) robot.play_mode.assign(word);
        if (!cursor.leave()) return wrong("GS");
      }
    }
    if (!cursor.leave()) return wrong("the end of an expression");
  }
  robot.parts_seen = seen;
  mujoco::rotation_of(&torso_quat[4 * r], &rotation[9 * r]);
  return {};
}

std::string MujocoExchange::lacking(int row) const {
  const int seen = robots_[row].parts_seen, expected = static_cast<int>(joints_) + 5;
  const std::size_t r = static_cast<std::size_t>(row);
  const bool whole = finite(&joint_angles[r * joints_], joints_) && finite(&joint_speeds[r * joints_], joints_) &&
                     finite(&torso_quat[4 * r], 4) && finite(&torso_pos[3 * r], 3) && finite(&gyro[3 * r], 3) && finite(&accel[3 * r], 3);
  if (!whole) return kNotFinite;
  if (seen == expected) return {};
  return std::to_string(seen) + " of " + std::to_string(expected) + " perceptors came (time, quat, pos, GYR, ACC, " +
         std::to_string(joints_) + " HJ)";
}

}  // namespace naosim::protocol
