#include "protocol.hpp"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <limits>

namespace naosim::protocol {

namespace {
constexpr double kDegrees = 180.0 / 3.14159265358979323846;
}  // namespace

PerceptorReader::PerceptorReader(const std::vector<std::string>& joints, const std::vector<std::string>& landmarks)
    : names_(joints), landmarks_(landmarks) {
  for (std::size_t k = 0; k < names_.size(); ++k) index_[names_[k]] = static_cast<int>(k);
  for (std::size_t k = 0; k < landmarks_.size(); ++k) landmark_[landmarks_[k]] = static_cast<int>(k);
}

std::string PerceptorReader::read(std::string_view message, const PerceptorTargets& to, GameState& game, int& joints_seen) const {
  Cursor cursor(message);
  std::string_view tag, field, word;
  joints_seen = 0;
  std::size_t next_joint = 0;  // servers list joints in an order of their own, which is mostly ours
  for (double* touch : to.touch)
    for (int c = 0; c < 6; ++c) touch[c] = std::numeric_limits<double>::quiet_NaN();
  std::fill_n(to.vision, 3 * landmarks_.size(), std::numeric_limits<double>::quiet_NaN());
  const auto wrong = [&](std::string_view what) {
    return "agent message, byte " + std::to_string(cursor.offset()) + ": " + std::string(what) + " cannot be read";
  };
  while (!cursor.done()) {
    if (!cursor.enter(tag)) return wrong("an expression");
    if (tag == "HJ") {
      int joint = -1;
      double angle = 0;
      bool turned = false;
      while (cursor.enter(field)) {
        if (field == "n" && cursor.atom(word)) {
          if (next_joint < names_.size() && names_[next_joint] == word) {
            joint = static_cast<int>(next_joint);
          } else if (const auto found = index_.find(word); found != index_.end()) {
            joint = found->second;
          }
          next_joint = static_cast<std::size_t>(joint + 1);
        } else if (field == "ax") {
          if (!cursor.number(angle)) return wrong("a joint angle");
          turned = true;
        }
        if (!cursor.leave()) return wrong("HJ");
      }
      if (!turned) return wrong("HJ");
      if (joint >= 0) {
        to.joint_angles[joint] = angle;
        ++joints_seen;
      }
    } else if (tag == "GYR" || tag == "ACC") {
      const bool rate = tag == "GYR";
      while (cursor.enter(field)) {
        if (field == (rate ? "rt" : "a") && !cursor.numbers(rate ? to.gyro : to.accel, 3)) return wrong(rate ? "GYR" : "ACC");
        if (!cursor.leave()) return wrong(rate ? "GYR" : "ACC");
      }
    } else if (tag == "FRP") {
      int sensor = -1;
      double values[6] = {};
      while (cursor.enter(field)) {
        if (field == "n" && cursor.atom(word)) sensor = word == "rf" ? 0 : word == "lf" ? 1 : word == "rf1" ? 2 : word == "lf1" ? 3 : -1;
        if ((field == "c" || field == "f") && !cursor.numbers(values + (field == "f" ? 3 : 0), 3)) return wrong("FRP");
        if (!cursor.leave()) return wrong("FRP");
      }
      if (sensor >= 0) std::memcpy(to.touch[sensor], values, sizeof values);
    } else if (tag == "See") {
      while (cursor.enter(field)) {
        const auto found = landmark_.find(field);
        if (found != landmark_.end()) {
          double* polar = to.vision + 3 * found->second;
          if (!cursor.enter(word) || word != "pol" || !cursor.numbers(polar, 3) || !cursor.leave()) return wrong("See");
        }
        if (!cursor.leave()) return wrong("See");
      }
    } else if (tag == "time") {
      while (cursor.enter(field)) {
        if (field == "now" && !cursor.number(*to.time)) return wrong("time");
        if (!cursor.leave()) return wrong("time");
      }
    } else if (tag == "GS") {
      double value;
      while (cursor.enter(field)) {
        if (field == "t") {
          if (!cursor.number(*to.game_time)) return wrong("GS");
        } else if (field == "unum") {
          if (cursor.number(value) && value >= 0 && value < 100) game.uniform_number = static_cast<int>(value);
        } else if (field == "team" && cursor.atom(word)) {
          game.side = word == "left" ? 1 : word == "right" ? 2 : 0;
        } else if (field == "pm" && cursor.atom(word)) {
          game.play_mode.assign(word);
        }
        if (!cursor.leave()) return wrong("GS");
      }
    }
    if (!cursor.leave()) return wrong("the end of an expression");
  }
  return {};
}

namespace {

void multiply(const double a[16], const double b[16], double out[16]) {
  for (int c = 0; c < 4; ++c)
    for (int r = 0; r < 4; ++r) {
      double sum = 0;
      for (int k = 0; k < 4; ++k) sum += a[4 * k + r] * b[4 * c + k];
      out[4 * c + r] = sum;
    }
}

constexpr std::array<double, 16> kIdentity = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
constexpr std::size_t kMaxNodes = 100000;
constexpr std::size_t kMaxDepth = 64;

}  // namespace

std::string SceneReader::read(std::string_view frame) {
  Cursor cursor(frame);
  std::string_view tag, word;
  const auto wrong = [&](std::string_view what) {
    return "monitor frame, byte " + std::to_string(cursor.offset()) + ": " + std::string(what) + " cannot be read";
  };
  if (!cursor.enter()) return wrong("the list of game values");
  while (cursor.enter(tag)) {
    double value;
    if (tag == "time" && cursor.number(value)) time_ = value;
    if (tag == "play_mode" && cursor.number(value) && value >= 0 && value < 1000) play_mode_ = static_cast<int>(value);
    if (!cursor.leave()) return wrong("a game value");
  }
  if (!cursor.leave()) return wrong("the list of game values");
  if (cursor.done()) return {};
  if (!cursor.enter(tag) || !cursor.leave()) return wrong("the kind of scene");
  const bool full = tag == "RSG";
  if (!full && tag != "RDS") return wrong("the kind of scene");
  if (!full && !complete_) return {};  // nothing to apply it to yet
  if (!cursor.enter()) return wrong("the scene");
  if (full) complete_ = false;
  std::string problem = read_nodes(cursor, full);
  if (problem.empty() && full) {
    complete_ = true;
    want(ball_);
    for (const Robot& robot : robots_) want(robot.node);
  }
  return problem;
}

void SceneReader::want(int node) {
  for (; node >= 0; node = nodes_[node].parent) nodes_[node].wanted = true;
}

std::string SceneReader::read_nodes(Cursor& cursor, bool full) {
  const auto wrong = [&](std::string_view what) {
    return "monitor frame, byte " + std::to_string(cursor.offset()) + ": " + std::string(what);
  };
  if (full) {
    nodes_.clear();
    robots_.clear();
    ball_ = -1;
  }
  std::vector<int> open;
  std::size_t next = 0;
  std::string_view tag, kind, word;
  for (;;) {
    if (!cursor.at_list()) {  // the end of a node, or of the scene
      if (!cursor.leave()) return wrong("the scene ends too early");
      if (open.empty()) break;
      open.pop_back();
      continue;
    }
    cursor.enter(tag);
    if (tag == "nd") {
      kind = {};
      cursor.atom(kind);
      if (next >= kMaxNodes || open.size() >= kMaxDepth) return wrong("the scene is too large");
      if (full) {
        nodes_.push_back({open.empty() ? -1 : open.back(), kind == "TRF", kIdentity, false});
      } else if (next >= nodes_.size() || nodes_[next].parent != (open.empty() ? -1 : open.back())) {
        return wrong("an incremental frame does not fit the last full one");
      }
      open.push_back(static_cast<int>(next++));
      continue;
    }
    const int self = open.empty() ? -1 : open.back();
    if (tag == "SLT" && self >= 0) {
      if ((full || nodes_[self].wanted) && !cursor.numbers(nodes_[self].pose.data(), 16))
        return wrong("a pose cannot be read");
    } else if (tag == "load" && full && self >= 0 && cursor.atom(word)) {
      const int parent = nodes_[self].parent;
      if (word.find("naobody") != word.npos && parent >= 0) {
        // the torso's mesh hangs below a node that turns it upright
        const int above = nodes_[parent].parent;
        robots_.push_back({above >= 0 ? above : parent, 0, 0});
      } else if (word.find("soccerball") != word.npos && parent >= 0) {
        ball_ = parent;
      }
    } else if (tag == "resetMaterials" && full && !robots_.empty()) {
      Robot& robot = robots_.back();
      while (cursor.atom(word)) {
        double value;
        if (word == "matLeft" || word == "matRight") {
          if (robot.side == 0) robot.side = word == "matLeft" ? 1 : 2;
        } else if (word.substr(0, 6) == "matNum" && parse_number(word.substr(6), value) && value > 0 && value < 100) {
          if (robot.uniform_number == 0) robot.uniform_number = static_cast<int>(value);
        }
      }
    }
    if (!cursor.leave()) return wrong("a node ends too early");
  }
  if (!full && next != nodes_.size()) return wrong("an incremental frame does not fit the last full one");
  return {};
}

void SceneReader::world(int node, double position[3], double rotation[9]) const {
  double pose[16];
  std::memcpy(pose, nodes_[node].pose.data(), sizeof pose);
  for (int above = nodes_[node].parent; above >= 0; above = nodes_[above].parent) {
    double product[16];
    multiply(nodes_[above].pose.data(), pose, product);
    std::memcpy(pose, product, sizeof pose);
  }
  for (int r = 0; r < 3; ++r) {
    position[r] = pose[12 + r];
    if (rotation == nullptr) continue;
    for (int c = 0; c < 3; ++c) rotation[3 * r + c] = pose[4 * c + r];
  }
}

bool SceneReader::torso(int side, int uniform_number, double position[3], double rotation[9]) const {
  if (!complete_) return false;
  for (const Robot& robot : robots_) {
    if (robots_.size() > 1 && (robot.side != side || robot.uniform_number != uniform_number)) continue;
    world(robot.node, position, rotation);
    return true;
  }
  return false;
}

bool SceneReader::ball(double position[3]) const {
  if (!complete_ || ball_ < 0) return false;
  world(ball_, position, nullptr);
  return true;
}

SceneWriter::SceneWriter(std::vector<Step> steps, int bodies) : steps_(std::move(steps)), sent_(bodies) {
  for (auto& pose : sent_) pose.fill(std::numeric_limits<float>::quiet_NaN());
}

std::string SceneWriter::write(std::string_view head, bool full, const double* poses) {
  constexpr float kMoved = 0.005f;
  std::string out(4, '\0');
  out.reserve(full ? 24576 : 8192);
  out += head;
  out += full ? "(RSG 0 1)(" : "(RDS 0 1)(";
  for (const Step& step : steps_) {
    if (step.body == kClose) {
      out += ')';
      continue;
    }
    out += full ? step.full : step.incremental;
    if (step.body == kStill) continue;
    const double *x = poses + 13 * step.body, *q = x + 3;
    const std::array<float, 16> pose = {
        static_cast<float>(1 - 2 * (q[2] * q[2] + q[3] * q[3])), static_cast<float>(2 * (q[1] * q[2] + q[0] * q[3])),
        static_cast<float>(2 * (q[1] * q[3] - q[0] * q[2])), 0.0f,
        static_cast<float>(2 * (q[1] * q[2] - q[0] * q[3])), static_cast<float>(1 - 2 * (q[1] * q[1] + q[3] * q[3])),
        static_cast<float>(2 * (q[2] * q[3] + q[0] * q[1])), 0.0f,
        static_cast<float>(2 * (q[1] * q[3] + q[0] * q[2])), static_cast<float>(2 * (q[2] * q[3] - q[0] * q[1])),
        static_cast<float>(1 - 2 * (q[1] * q[1] + q[2] * q[2])), 0.0f,
        static_cast<float>(x[0]), static_cast<float>(x[1]), static_cast<float>(x[2]), 1.0f};
    auto& sent = sent_[step.body];
    bool moved = full;
    for (int k = 0; k < 16 && !moved; ++k) moved = !(std::fabs(pose[k] - sent[k]) <= kMoved);
    if (!moved) continue;
    // a full frame may be for one monitor only: the others, and it, get every pose in the next incremental one
    if (full)
      sent.fill(std::numeric_limits<float>::quiet_NaN());
    else
      sent = pose;
    out += " (SLT";
    for (const float value : pose) {
      out += ' ';
      append_general(out, value);
    }
    out += ')';
  }
  out += ')';
  append_size(out, 0);
  return out;
}

std::string PerceptorWriter::write(std::string_view head, std::string_view see, const double* gyro, const double* accel,
                                 const double* angles, const double* const touch[4]) const {
  std::string out(4, '\0');
  out.reserve(4096);
  out += head;
  const auto numbers = [&](const double* values, int count) {
    for (int k = 0; k < count; ++k) {
      out += ' ';
      append_fixed(out, values[k], digits_);
    }
  };
  out += "(GYR (n torso) (rt";
  numbers(gyro, 3);
  out += "))(ACC (n torso) (a";
  numbers(accel, 3);
  out += "))";
  for (const Item& item : items_) {
    if (item.kind == 's') {
      out += see;
    } else if (item.kind == 'j') {
      out += "(HJ (n ";
      out += item.name;
      out += ") (ax";
      numbers(angles + item.index, 1);
      out += "))";
    } else if (!std::isnan(touch[item.index][0])) {
      out += "(FRP (n ";
      out += item.name;
      out += ") (c";
      numbers(touch[item.index], 3);
      out += ") (f";
      numbers(touch[item.index] + 3, 3);
      out += "))";
    }
  }
  append_size(out, 0);
  return out;
}

namespace {
constexpr double kHalfCone = 60.0;              // degrees, both ways
constexpr double kNearest = 0.1;                // m
constexpr double kOffset = 0.005;               // m, largest of the run's fixed offset
constexpr double kDistanceSpread = 0.0965;      // percent
constexpr double kThetaSpread = 0.1480, kPhiSpread = 0.1225;  // degrees
}  // namespace

Vision::Vision(std::vector<Landmark> landmarks, std::vector<Line> lines, int digits, std::uint64_t seed, bool noise)
    : landmarks_(std::move(landmarks)), lines_(std::move(lines)), digits_(digits), noise_(noise), random_(seed) {
  std::uniform_real_distribution<double> offset(-kOffset, kOffset);
  if (noise_)
    for (double& error : error_) error = offset(random_);
}

void Vision::local(const double world[3], double out[3]) const {
  for (int c = 0; c < 3; ++c) {
    out[c] = error_[c];
    for (int r = 0; r < 3; ++r) out[c] += rotation_[3 * r + c] * (world[r] - position_[r]);
  }
}

bool Vision::visible(const double relative[3], Polar& out) const {
  out.distance = std::sqrt(relative[0] * relative[0] + relative[1] * relative[1] + relative[2] * relative[2]);
  // theta: 0 straight ahead (+y), positive to the left; phi: positive up
  out.theta = std::atan2(-relative[0], relative[1]) * kDegrees;
  out.phi = std::atan2(relative[2], std::hypot(relative[0], relative[1])) * kDegrees;
  return out.distance > kNearest && std::fabs(out.theta) <= kHalfCone && std::fabs(out.phi) <= kHalfCone;
}

void Vision::blur(Polar& seen) {
  if (!noise_) return;
  seen.distance += normal_(random_) * kDistanceSpread * seen.distance / 100.0;
  seen.theta += normal_(random_) * kThetaSpread;
  seen.phi += normal_(random_) * kPhiSpread;
}

void Vision::append(std::string& out, const Polar& seen) const {
  out += "(pol ";
  append_fixed(out, seen.distance, digits_);
  out += ' ';
  append_fixed(out, seen.theta, digits_);
  out += ' ';
  append_fixed(out, seen.phi, digits_);
  out += ')';
}

void Vision::append_landmark(std::string& out, const Landmark& landmark) {
  double relative[3];
  Polar seen;
  local(landmark.position, relative);
  if (!visible(relative, seen)) return;
  blur(seen);
  out += " (";
  out += landmark.name;
  out += ' ';
  append(out, seen);
  out += ')';
}

std::string Vision::see(const double position[3], const double rotation[9], const std::vector<Landmark>& moving, std::string_view self,
                        const std::vector<Landmark>& parts) {
  std::memcpy(position_, position, sizeof position_);
  std::memcpy(rotation_, rotation, sizeof rotation_);
  std::string out;
  out.reserve(2048);
  for (const auto& landmark : landmarks_) append_landmark(out, landmark);
  for (const auto& landmark : moving) append_landmark(out, landmark);
  if (!self.empty()) {
    std::string seen;
    for (const auto& part : parts) append_landmark(seen, part);
    if (!seen.empty()) {
      out += " (P ";
      out += self;
      out += seen;
      out += ')';
    }
  }
  const double slope = std::tan(kHalfCone / kDegrees);
  for (const Line& line : lines_) {
    double ends[2][3];
    Polar seen[2];
    bool in[2];
    for (int e = 0; e < 2; ++e) {
      local(line.data() + 3 * e, ends[e]);
      in[e] = visible(ends[e], seen[e]);
    }
    if (!in[0] || !in[1]) {
      // Cut with the four planes of the view: slope * y +- x >= 0 and slope * y +- z >= 0.
      double first = 0.0, last = 1.0;
      for (int plane = 0; plane < 4; ++plane) {
        const int axis = plane < 2 ? 0 : 2;
        const double sign = plane % 2 ? -1.0 : 1.0;
        const double a = slope * ends[0][1] + sign * ends[0][axis], b = slope * ends[1][1] + sign * ends[1][axis];
        if (a < 0 && b < 0) first = 2.0;
        if (a < 0 && b >= 0) first = std::max(first, a / (a - b));
        if (a >= 0 && b < 0) last = std::min(last, a / (a - b));
      }
      if (in[0]) first = 0.0;
      if (in[1]) last = 1.0;
      if (first >= last || (!in[0] && first == 0.0 && !in[1] && last == 1.0)) continue;
      double cut[2][3];
      for (int c = 0; c < 3; ++c) {
        cut[0][c] = ends[0][c] + (ends[1][c] - ends[0][c]) * first;
        cut[1][c] = ends[0][c] + (ends[1][c] - ends[0][c]) * last;
      }
      visible(cut[0], seen[0]);
      visible(cut[1], seen[1]);
      if (seen[0].distance <= kNearest || seen[1].distance <= kNearest) continue;
    }
    blur(seen[0]);
    blur(seen[1]);
    out += " (L ";
    append(out, seen[0]);
    out += ' ';
    append(out, seen[1]);
    out += ')';
  }
  return out.empty() ? std::string("(See )") : "(See" + out + ")";
}

}  // namespace naosim::protocol
