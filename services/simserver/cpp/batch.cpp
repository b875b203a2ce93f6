#include "batch.hpp"

#include <cmath>
#include <cstring>
#include <limits>

namespace naosim {

ThreadPool::ThreadPool(int threads) {
  for (int k = 1; k < threads; ++k) helpers_.emplace_back([this] { help(); });
}

ThreadPool::~ThreadPool() {
  {
    std::lock_guard<std::mutex> lock(mutex_);
    stop_ = true;
  }
  start_.notify_all();
  for (auto& helper : helpers_) helper.join();
}

void ThreadPool::work() {
  for (int k = next_.fetch_add(1); k < count_; k = next_.fetch_add(1)) (*job_)(k);
}

void ThreadPool::help() {
  std::uint64_t seen = 0;
  std::unique_lock<std::mutex> lock(mutex_);
  for (;;) {
    start_.wait(lock, [&] { return stop_ || round_ != seen; });
    if (stop_) return;
    seen = round_;
    lock.unlock();
    work();
    lock.lock();
    if (--busy_ == 0) done_.notify_one();
  }
}

void ThreadPool::run(int count, const std::function<void(int)>& job) {
  if (helpers_.empty() || count < 2) {
    for (int k = 0; k < count; ++k) job(k);
    return;
  }
  {
    std::lock_guard<std::mutex> lock(mutex_);
    job_ = &job;
    count_ = count;
    next_ = 0;
    busy_ = static_cast<int>(helpers_.size());
    ++round_;
  }
  start_.notify_all();
  work();
  std::unique_lock<std::mutex> lock(mutex_);
  done_.wait(lock, [&] { return busy_ == 0; });
}

Batch::Batch(Model model, int n, int threads, int digits, bool self_collision, const Kernel& kernel)
    : model_(std::move(model)),
      n_(n),
      scale_(digits < 0 ? 0.0 : std::pow(10.0, digits)),
      self_collision_(self_collision),
      kernel_(kernel),
      groups_((n + kLanes - 1) / kLanes),
      statistics_(groups_.size()),
      pool_(threads) {
  const std::size_t rows = static_cast<std::size_t>(n);
  out_.joint_angles.assign(rows * model_.joint_count(), 0.0);
  out_.gyro.assign(rows * 3, 0.0);
  out_.accel.assign(rows * 3, 0.0);
  for (auto& touch : out_.touch) touch.assign(rows * 6, 0.0);
  out_.time.assign(rows, 0.0);
  out_.torso_position.assign(rows * 3, 0.0);
  out_.torso_rotation.assign(rows * 9, 0.0);
  // Spare lanes of the last group get a robot too, so that they never compute on garbage; nobody sees them.
  for (auto& group : groups_) {
    std::memset(static_cast<void*>(&group), 0, sizeof group);
    for (int lane = 0; lane < kLanes; ++lane) spawn(group, lane);
  }
  reset(nullptr);
}

unsigned Batch::lanes_of(int group, const std::uint8_t* lanes) const {
  unsigned chosen = 0;
  for (int lane = 0; lane < kLanes; ++lane) {
    const int environment = group * kLanes + lane;
    if (environment < n_ && (lanes == nullptr || lanes[environment])) chosen |= 1u << lane;
  }
  return chosen;
}

void Batch::spawn(Group& group, int lane) const {
  auto* words = reinterpret_cast<double*>(&group);
  for (std::size_t k = 0; k < sizeof(Group) / sizeof(Real); ++k) words[k * kLanes + lane] = 0.0;
  for (int i = 0; i < model_.body_count(); ++i) {
    for (int c = 0; c < 3; ++c) group.position[i][c][lane] = model_.bodies[i].offset[c];
    group.quaternion[i][0][lane] = 1.0;
    group.enabled[i][lane] = -1;
    group.idle_left[i][lane] = 10.0;
  }
  for (auto& at : group.frozen_at) at[lane] = kNeverFrozen;
  for (Senses* senses : {&group.sensed, &group.delivered}) {
    senses->accel[2][lane] = static_cast<double>(9.81f);
    for (auto& sensor : senses->touch)
      for (auto& value : sensor) value[lane] = std::numeric_limits<double>::quiet_NaN();
  }
}

double Batch::printed(double value) const {
  if (scale_ == 0.0) return value;
  // The server prints single precision with a fixed number of decimals; the product is exact in double.
  return std::nearbyint(static_cast<double>(static_cast<float>(value)) * scale_) / scale_;
}

void Batch::publish(int index, unsigned lanes) {
  const Group& g = groups_[index];
  const int joints = model_.joint_count();
  for (int lane = 0; lane < kLanes; ++lane) {
    if (!(lanes >> lane & 1u)) continue;
    const std::size_t row = static_cast<std::size_t>(index) * kLanes + lane;
    const Senses& s = g.delivered;
    for (int j = 0; j < joints; ++j) out_.joint_angles[row * joints + j] = printed(s.joint_angle[j][lane]);
    for (int c = 0; c < 3; ++c) {
      out_.gyro[row * 3 + c] = printed(s.gyro[c][lane]);
      out_.accel[row * 3 + c] = printed(s.accel[c][lane]);
      out_.torso_position[row * 3 + c] = g.position[0][c][lane];
    }
    for (int t = 0; t < kTouchSensors; ++t)
      if (model_.touch_body[t] >= 0)
        for (int c = 0; c < 6; ++c) out_.touch[t][row * 6 + c] = printed(s.touch[t][c][lane]);
    out_.time[row] = s.time[lane];
    const double w = g.quaternion[0][0][lane], x = g.quaternion[0][1][lane], y = g.quaternion[0][2][lane], z = g.quaternion[0][3][lane];
    const double r[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                         2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                         2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
    std::memcpy(&out_.torso_rotation[row * 9], r, sizeof r);
  }
}

int Batch::step(const double* speeds, const std::uint8_t* lanes) {
  const int joints = model_.joint_count();
  std::atomic<int> bad{std::numeric_limits<int>::max()};
  pool_.run(groups(), [&](int index) {
    const unsigned chosen = lanes_of(index, lanes);
    if (chosen == 0) return;
    Real command[kMaxBodies - 1] = {};
    for (int lane = 0; lane < kLanes; ++lane) {
      if (!(chosen >> lane & 1u)) continue;
      const double* row = speeds + (static_cast<std::size_t>(index) * kLanes + lane) * joints;
      for (int j = 0; j < joints; ++j) command[j][lane] = row[j];
    }
    Group& g = groups_[index];
    unsigned failed = kernel_.step(model_, g, command, chosen, self_collision_, statistics_[index]);
    publish(index, chosen);
    for (int lane = 0; lane < kLanes; ++lane) {
      // one body that is not finite makes the whole tree so
      const double sum = g.position[0][0][lane] + g.position[0][1][lane] + g.position[0][2][lane] + g.quaternion[0][0][lane];
      if ((chosen >> lane & 1u) && !std::isfinite(sum)) failed |= 1u << lane;
      if (failed >> lane & 1u) {
        int first = bad.load();
        const int environment = index * kLanes + lane;
        while (environment < first && !bad.compare_exchange_weak(first, environment)) {
        }
      }
    }
  });
  return bad == std::numeric_limits<int>::max() ? -1 : bad.load();
}

void Batch::reset(const std::uint8_t* lanes) {
  for (int index = 0; index < groups(); ++index) {
    const unsigned chosen = lanes_of(index, lanes);
    for (int lane = 0; lane < kLanes; ++lane)
      if (chosen >> lane & 1u) spawn(groups_[index], lane);
    if (chosen) publish(index, chosen);
  }
}

void Batch::beam(const double* position, const double* yaw_deg, const std::uint8_t* lanes) {
  for (int index = 0; index < groups(); ++index) {
    const unsigned chosen = lanes_of(index, lanes);
    if (chosen == 0) continue;
    Group& g = groups_[index];
    for (int lane = 0; lane < kLanes; ++lane) {
      if (!(chosen >> lane & 1u)) continue;
      const int environment = index * kLanes + lane;
      const double half = yaw_deg[environment] * 3.14159265358979323846 / 360.0;
      // turn = upright * inverse(torso), applied to every body about the torso
      const double up[4] = {std::cos(half), 0, 0, std::sin(half)};
      const double t[4] = {g.quaternion[0][0][lane], -g.quaternion[0][1][lane], -g.quaternion[0][2][lane], -g.quaternion[0][3][lane]};
      const auto times = [](const double a[4], const double b[4], double out[4]) {
        out[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
        out[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
        out[2] = a[0] * b[2] + a[2] * b[0] + a[3] * b[1] - a[1] * b[3];
        out[3] = a[0] * b[3] + a[3] * b[0] + a[1] * b[2] - a[2] * b[1];
      };
      double turn[4];
      times(up, t, turn);
      const double origin[3] = {g.position[0][0][lane], g.position[0][1][lane], g.position[0][2][lane]};
      for (int i = 0; i < model_.body_count(); ++i) {
        const double d[4] = {0, g.position[i][0][lane] - origin[0], g.position[i][1][lane] - origin[1], g.position[i][2][lane] - origin[2]};
        const double back[4] = {turn[0], -turn[1], -turn[2], -turn[3]};
        double half_way[4], moved[4], q[4];
        times(turn, d, half_way);
        times(half_way, back, moved);
        for (int c = 0; c < 3; ++c) {
          g.position[i][c][lane] = position[environment * 3 + c] + moved[1 + c];
          g.velocity[i][c][lane] = 0.0;
          g.spin[i][c][lane] = 0.0;
        }
        const double old[4] = {g.quaternion[i][0][lane], g.quaternion[i][1][lane], g.quaternion[i][2][lane], g.quaternion[i][3][lane]};
        times(turn, old, q);
        const double norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        for (int c = 0; c < 4; ++c) g.quaternion[i][c][lane] = i == 0 ? up[c] : q[c] / norm;
      }
    }
    publish(index, chosen);
  }
}

void Batch::set_bodies(const double* bodies, const std::uint8_t* lanes) {
  const int count = model_.body_count();
  for (int index = 0; index < groups(); ++index) {
    const unsigned chosen = lanes_of(index, lanes);
    if (chosen == 0) continue;
    Group& g = groups_[index];
    for (int lane = 0; lane < kLanes; ++lane) {
      if (!(chosen >> lane & 1u)) continue;
      for (int i = 0; i < count; ++i) {
        const double* s = bodies + ((static_cast<std::size_t>(index) * kLanes + lane) * count + i) * kBodyState;
        const double norm = std::sqrt(s[3] * s[3] + s[4] * s[4] + s[5] * s[5] + s[6] * s[6]);
        const bool unit = std::fabs(norm - 1.0) < 1e-12;  // keep a recorded state's bits
        for (int c = 0; c < 3; ++c) {
          g.position[i][c][lane] = s[c];
          g.velocity[i][c][lane] = s[7 + c];
          g.spin[i][c][lane] = s[10 + c];
        }
        for (int c = 0; c < 4; ++c) g.quaternion[i][c][lane] = unit ? s[3 + c] : s[3 + c] / norm;
      }
    }
    kernel_.refresh(model_, g, chosen, false);
    publish(index, chosen);
  }
}

void Batch::set_enabled(const std::uint8_t* enabled, const std::uint8_t* lanes) {
  const int count = model_.body_count();
  for (int environment = 0; environment < n_; ++environment) {
    if (lanes != nullptr && !lanes[environment]) continue;
    Group& g = groups_[environment / kLanes];
    for (int i = 0; i < count; ++i) {
      const bool on = enabled[environment * count + i] != 0;
      g.enabled[i][environment % kLanes] = on ? -1 : 0;
      g.idle_left[i][environment % kLanes] = on ? 10.0 : 0.0;
    }
  }
}

void Batch::get_bodies(double* bodies) const {
  const int count = model_.body_count();
  for (int environment = 0; environment < n_; ++environment) {
    const Group& g = groups_[environment / kLanes];
    const int lane = environment % kLanes;
    for (int i = 0; i < count; ++i, bodies += kBodyState) {
      for (int c = 0; c < 3; ++c) {
        bodies[c] = g.position[i][c][lane];
        bodies[7 + c] = g.velocity[i][c][lane];
        bodies[10 + c] = g.spin[i][c][lane];
      }
      for (int c = 0; c < 4; ++c) bodies[3 + c] = g.quaternion[i][c][lane];
    }
  }
}

void Batch::get_enabled(std::uint8_t* enabled) const {
  const int count = model_.body_count();
  for (int environment = 0; environment < n_; ++environment)
    for (int i = 0; i < count; ++i) *enabled++ = groups_[environment / kLanes].enabled[i][environment % kLanes] != 0;
}

void Batch::centre_of_mass(double* out) const {
  for (int environment = 0; environment < n_; ++environment) {
    const Group& g = groups_[environment / kLanes];
    double sum[3] = {}, mass = 0;
    for (int i = 0; i < model_.body_count(); ++i) {
      const double m = model_.bodies[i].mass;
      mass += m;
      for (int c = 0; c < 3; ++c) sum[c] += m * g.position[i][c][environment % kLanes];
    }
    for (const double s : sum) *out++ = s / mass;
  }
}

void Batch::snapshot(int environment, std::uint8_t* to) const {
  const auto* from = reinterpret_cast<const std::uint8_t*>(&groups_[environment / kLanes]) + 8 * (environment % kLanes);
  for (std::size_t k = 0; k < sizeof(Group) / sizeof(Real); ++k) std::memcpy(to + 8 * k, from + sizeof(Real) * k, 8);
}

void Batch::restore(int environment, const std::uint8_t* from) {
  auto* to = reinterpret_cast<std::uint8_t*>(&groups_[environment / kLanes]) + 8 * (environment % kLanes);
  for (std::size_t k = 0; k < sizeof(Group) / sizeof(Real); ++k) std::memcpy(to + sizeof(Real) * k, from + 8 * k, 8);
  publish(environment / kLanes, 1u << (environment % kLanes));
}

Statistics Batch::statistics() const {
  Statistics sum;
  for (const auto& s : statistics_) {
    sum.steps += s.steps;
    sum.solves += s.solves;
    sum.fallback += s.fallback;
  }
  return sum;
}

void centre_of_mass_from_angles(const Model& model, const double* angles_deg, int n, double* out) {
  const int bodies = model.body_count(), joints = model.joint_count();
  struct Pose {
    double r[9], x[3];
  };
  std::vector<Pose> pose(bodies);
  for (int e = 0; e < n; ++e, angles_deg += joints, out += 3) {
    double mass = 0, sum[3] = {};
    for (int i = 0; i < bodies; ++i) {
      const Body& body = model.bodies[i];
      Pose& p = pose[i];
      if (body.parent < 0) {
        p = {{1, 0, 0, 0, 1, 0, 0, 0, 1}, {0, 0, 0}};
      } else {
        const Pose& q = pose[body.parent];
        const double angle = angles_deg[body.joint] * 3.14159265358979323846 / 180.0;
        const double c = std::cos(angle), s = std::sin(angle), v = 1 - c, *u = body.axis;
        const double turn[9] = {c + u[0] * u[0] * v,        u[0] * u[1] * v - u[2] * s, u[0] * u[2] * v + u[1] * s,
                                u[1] * u[0] * v + u[2] * s, c + u[1] * u[1] * v,        u[1] * u[2] * v - u[0] * s,
                                u[2] * u[0] * v - u[1] * s, u[2] * u[1] * v + u[0] * s, c + u[2] * u[2] * v};
        for (int a = 0; a < 3; ++a)
          for (int b = 0; b < 3; ++b)
            p.r[3 * a + b] = q.r[3 * a] * turn[b] + q.r[3 * a + 1] * turn[3 + b] + q.r[3 * a + 2] * turn[6 + b];
        for (int a = 0; a < 3; ++a) {
          p.x[a] = q.x[a];
          for (int b = 0; b < 3; ++b) p.x[a] += q.r[3 * a + b] * body.parent_anchor[b] - p.r[3 * a + b] * body.anchor[b];
        }
      }
      mass += body.mass;
      for (int a = 0; a < 3; ++a) sum[a] += body.mass * p.x[a];
    }
    for (int a = 0; a < 3; ++a) out[a] = sum[a] / mass;
  }
}

}  // namespace naosim
