#include "batch.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <stdexcept>

namespace naosim {

namespace {
void centres_of_mass_for_others(const void* model, const double* angles_deg, std::ptrdiff_t stride, const std::int64_t* rows, int count, double* out);
}

Batch::Batch(Model model, int n, int threads, int digits, bool self_collision, const Kernel& kernel)
    : model_(std::move(model)),
      n_(n),
      scale_(digits < 0 ? 0.0 : std::pow(10.0, digits)),
      self_collision_(self_collision),
      kernel_(kernel),
      lanes_(kernel.lanes),
      groups_((n + lanes_ - 1) / lanes_),
      words_(new (std::align_val_t{64}) double[static_cast<std::size_t>(groups_) * kWords * lanes_]),
      statistics_(groups_),
      pool_(threads),
      kinematics_{&model_, centres_of_mass_for_others} {
  const std::size_t rows = static_cast<std::size_t>(n);
  out_.joint_angles.assign(rows * model_.joint_count(), 0.0);
  out_.gyro.assign(rows * 3, 0.0);
  out_.accel.assign(rows * 3, 0.0);
  for (auto& touch : out_.touch) touch.assign(rows * 6, 0.0);
  out_.time.assign(rows, 0.0);
  out_.torso_position.assign(rows * 3, 0.0);
  out_.torso_rotation.assign(rows * 9, 0.0);
  // Unused lanes of the last group get a robot too, so that they never compute on uninitialised values.
  const Environment fresh = spawned();
  for (int environment = 0; environment < groups_ * lanes_; ++environment) store(environment, fresh);
  for (int environment = 0; environment < n_; ++environment) publish(environment);
}

void Batch::gather(int environment, std::size_t first, std::size_t count, void* to) const {
  const double* from = group(environment / lanes_) + environment % lanes_;
  auto* out = static_cast<double*>(to);
  for (std::size_t k = 0; k < count; ++k) std::memcpy(out + k, from + (first + k) * lanes_, sizeof(double));
}

Environment Batch::load(int environment) const {
  Environment state;
  gather(environment, 0, kWords, &state);
  return state;
}

void Batch::store(int environment, const Environment& state) {
  double* to = group(environment / lanes_) + environment % lanes_;
  const auto* from = reinterpret_cast<const double*>(&state);
  for (std::size_t k = 0; k < kWords; ++k) std::memcpy(to + k * lanes_, from + k, sizeof(double));
}

void Batch::restore(int environment, const Environment& state) {
  store(environment, state);
  publish(environment);
}

unsigned Batch::lanes_of(int group, const std::uint8_t* lanes) const {
  unsigned chosen = 0;
  for (int lane = 0; lane < lanes_; ++lane) {
    const int environment = group * lanes_ + lane;
    if (environment < n_ && (lanes == nullptr || lanes[environment])) chosen |= 1u << lane;
  }
  return chosen;
}

// Change chosen environments one by one.
template <class Change>
void Batch::edit(const std::uint8_t* lanes, Change change) {
  for (int environment = 0; environment < n_; ++environment) {
    if (lanes != nullptr && !lanes[environment]) continue;
    Environment state = load(environment);
    change(environment, state);
    restore(environment, state);
  }
}

Environment Batch::spawned() const {
  Environment state;
  std::memset(static_cast<void*>(&state), 0, sizeof state);
  for (int i = 0; i < model_.body_count(); ++i) {
    for (int c = 0; c < 3; ++c) state.position[i][c] = model_.bodies[i].offset[c];
    state.quaternion[i][0] = 1.0;
    state.enabled[i] = -1;
    state.idle_left[i] = 10.0;
  }
  for (auto& at : state.frozen_at) at = kNeverFrozen;
  for (auto* perceptors : {&state.perceptors, &state.sent_perceptors}) {
    perceptors->accel[2] = static_cast<double>(9.81f);
    for (auto& sensor : perceptors->touch)
      for (auto& value : sensor) value = std::numeric_limits<double>::quiet_NaN();
  }
  return state;
}

double Batch::printed(double value) const {
  if (scale_ == 0.0) return value;
  // The server prints single precision with a fixed number of decimals; the product is exact in double.
  return std::nearbyint(static_cast<double>(static_cast<float>(value)) * scale_) / scale_;
}

void Batch::publish(int environment) {
  const std::size_t row = static_cast<std::size_t>(environment);
  const int joints = model_.joint_count();
  PerceptorsOf<double> s;
  double x[3], q[4];
  gather(environment, offsetof(Environment, sent_perceptors) / sizeof(double), sizeof s / sizeof(double), &s);
  gather(environment, offsetof(Environment, position) / sizeof(double), 3, x);
  gather(environment, offsetof(Environment, quaternion) / sizeof(double), 4, q);
  for (int j = 0; j < joints; ++j) out_.joint_angles[row * joints + j] = printed(s.joint_angle[j]);
  for (int c = 0; c < 3; ++c) {
    out_.gyro[row * 3 + c] = printed(s.gyro[c]);
    out_.accel[row * 3 + c] = printed(s.accel[c]);
    out_.torso_position[row * 3 + c] = x[c];
  }
  for (int t = 0; t < kTouchSensors; ++t)
    if (model_.touch_body[t] >= 0)
      for (int c = 0; c < 6; ++c) out_.touch[t][row * 6 + c] = printed(s.touch[t][c]);
  out_.time[row] = s.time;
  const double r[9] = {1 - 2 * (q[2] * q[2] + q[3] * q[3]), 2 * (q[1] * q[2] - q[0] * q[3]),     2 * (q[1] * q[3] + q[0] * q[2]),
                       2 * (q[1] * q[2] + q[0] * q[3]),     1 - 2 * (q[1] * q[1] + q[3] * q[3]), 2 * (q[2] * q[3] - q[0] * q[1]),
                       2 * (q[1] * q[3] - q[0] * q[2]),     2 * (q[2] * q[3] + q[0] * q[1]),     1 - 2 * (q[1] * q[1] + q[2] * q[2])};
  std::memcpy(&out_.torso_rotation[row * 9], r, sizeof r);
}

// Run a cycle of one group; command(row, joint) is a joint's speed.
template <class Command>
void Batch::step_group(int index, const std::uint8_t* lanes, const Command& command_of, std::atomic<int>& bad) {
  const int joints = model_.joint_count();
  const unsigned chosen = lanes_of(index, lanes);
  if (chosen == 0) return;
  alignas(64) double command[(kMaxBodies - 1) * 8] = {};
  for (int lane = 0; lane < lanes_; ++lane) {
    if (!(chosen >> lane & 1u)) continue;
    const std::size_t row = static_cast<std::size_t>(index) * lanes_ + lane;
    for (int j = 0; j < joints; ++j) command[j * lanes_ + lane] = command_of(row, j);
  }
  const unsigned failed = kernel_.step(model_, group(index), command, chosen, self_collision_, statistics_[index]);
  for (int lane = 0; lane < lanes_; ++lane) {
    if (!(chosen >> lane & 1u)) continue;
    const int environment = index * lanes_ + lane;
    publish(environment);
    // one body that is not finite makes the whole tree so
    const double* x = &out_.torso_position[static_cast<std::size_t>(environment) * 3];
    const double* r = &out_.torso_rotation[static_cast<std::size_t>(environment) * 9];
    if (!(failed >> lane & 1u) && std::isfinite(x[0] + x[1] + x[2] + r[0])) continue;
    for (int first = bad; environment < first && !bad.compare_exchange_weak(first, environment);) {
    }
  }
}

template <class Command>
int Batch::run(const std::uint8_t* lanes, Command command_of) {
  Cycle cycle;
  pool_.run(groups_, [&](int index) { step_group(index, lanes, command_of, cycle.bad); });
  return cycle.result();
}

int Batch::step(const double* speeds, const std::uint8_t* lanes) {
  const std::size_t joints = static_cast<std::size_t>(model_.joint_count());
  return run(lanes, [=](std::size_t row, int j) { return speeds[row * joints + j]; });
}

// Whether a row's target and perceived angles are finite.
bool Batch::finite(const double* targets, int row) const {
  const std::size_t joints = static_cast<std::size_t>(model_.joint_count());
  const double* angles = &out_.joint_angles[static_cast<std::size_t>(row) * joints];
  double sum = 0.0;  // 0 times a number that is not finite is NaN
  for (std::size_t j = 0; j < joints; ++j) sum += 0.0 * targets[j] + 0.0 * angles[j];
  return sum == 0.0;
}

// Speeds of joints that a proportional controller drives to the targets of the rows from `first` on.
struct Controller {
  const double *targets, *angles, *max_speed;
  double gain;
  std::size_t joints, first;
  double operator()(std::size_t row, int j) const {
    const double wanted = gain * (targets[(row - first) * joints + j] - angles[row * joints + j] * (3.14159265358979323846 / 180.0));
    return std::min(std::max(wanted, -max_speed[j]), max_speed[j]);
  }
};

int Batch::drive(const double* targets, double gain, const double* max_speed, const std::uint8_t* lanes) {
  const std::size_t joints = static_cast<std::size_t>(model_.joint_count());
  for (int row = 0; row < n_; ++row)
    if ((lanes == nullptr || lanes[row]) && !finite(targets + row * joints, row)) return kNotFinite;
  return run(lanes, Controller{targets, out_.joint_angles.data(), max_speed, gain, joints, 0});
}

int Batch::begin_drive(const double* targets, double gain, const double* max_speed, int first, int count) {
  const std::size_t joints = static_cast<std::size_t>(model_.joint_count());
  for (int k = 0; k < count; ++k)
    if (!finite(targets + k * joints, first + k)) return kNotFinite;
  Cycle& cycle = cycles_[first];
  if (cycle.running) throw std::logic_error("begin_drive: the cycle before is not finished");
  cycle.running = true;
  cycle.targets.assign(targets, targets + count * joints);
  cycle.max_speed.assign(max_speed, max_speed + joints);
  cycle.bad = kNone;
  const Controller controller{cycle.targets.data(), out_.joint_angles.data(), cycle.max_speed.data(), gain, joints, static_cast<std::size_t>(first)};
  cycle.round.count = (count + lanes_ - 1) / lanes_;
  cycle.round.job = [this, controller, &cycle, group = first / lanes_](int index) { step_group(group + index, nullptr, controller, cycle.bad); };
  pool_.begin(cycle.round);
  return -1;
}

int Batch::finish_drive(int first) {
  Cycle& cycle = cycles_[first];
  if (!cycle.running) throw std::logic_error("finish_drive: no cycle has begun");
  pool_.finish(cycle.round);
  cycle.running = false;
  return cycle.result();
}

void Batch::reset(const std::uint8_t* lanes) {
  const Environment fresh = spawned();
  edit(lanes, [&](int, Environment& state) { state = fresh; });
}

void Batch::beam(const double* position, const double* yaw_deg, const std::uint8_t* lanes) {
  const auto times = [](const double a[4], const double b[4], double out[4]) {
    out[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
    out[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
    out[2] = a[0] * b[2] + a[2] * b[0] + a[3] * b[1] - a[1] * b[3];
    out[3] = a[0] * b[3] + a[3] * b[0] + a[1] * b[2] - a[2] * b[1];
  };
  edit(lanes, [&](int environment, Environment& state) {
    const double half = yaw_deg[environment] * 3.14159265358979323846 / 360.0;
    // turn = upright * inverse(torso), applied to every body about the torso
    const double up[4] = {std::cos(half), 0, 0, std::sin(half)};
    const double* t = state.quaternion[0];
    const double undo[4] = {t[0], -t[1], -t[2], -t[3]};
    double turn[4];
    times(up, undo, turn);
    const double back[4] = {turn[0], -turn[1], -turn[2], -turn[3]};
    const double origin[3] = {state.position[0][0], state.position[0][1], state.position[0][2]};
    for (int i = 0; i < model_.body_count(); ++i) {
      const double arm[4] = {0, state.position[i][0] - origin[0], state.position[i][1] - origin[1], state.position[i][2] - origin[2]};
      double half_way[4], moved[4], q[4];
      times(turn, arm, half_way);
      times(half_way, back, moved);
      times(turn, state.quaternion[i], q);
      const double norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
      for (int c = 0; c < 3; ++c) {
        state.position[i][c] = position[environment * 3 + c] + moved[1 + c];
        state.velocity[i][c] = state.spin[i][c] = 0.0;
      }
      for (int c = 0; c < 4; ++c) state.quaternion[i][c] = i == 0 ? up[c] : q[c] / norm;
    }
  });
}

void Batch::set_bodies(const double* bodies, const std::uint8_t* lanes) {
  const int count = model_.body_count();
  edit(lanes, [&](int environment, Environment& state) {
    for (int i = 0; i < count; ++i) {
      const double* s = bodies + (static_cast<std::size_t>(environment) * count + i) * kBodyState;
      const double norm = std::sqrt(s[3] * s[3] + s[4] * s[4] + s[5] * s[5] + s[6] * s[6]);
      const bool unit = std::fabs(norm - 1.0) < 1e-12;  // keep a recorded state's bits
      for (int c = 0; c < 3; ++c) {
        state.position[i][c] = s[c];
        state.velocity[i][c] = s[7 + c];
        state.spin[i][c] = s[10 + c];
      }
      for (int c = 0; c < 4; ++c) state.quaternion[i][c] = unit ? s[3 + c] : s[3 + c] / norm;
    }
  });
  for (int index = 0; index < groups_; ++index) kernel_.refresh(model_, group(index), lanes_of(index, lanes));
}

void Batch::set_enabled(const std::uint8_t* enabled, const std::uint8_t* lanes) {
  const int count = model_.body_count();
  edit(lanes, [&](int environment, Environment& state) {
    for (int i = 0; i < count; ++i) {
      const bool on = enabled[environment * count + i] != 0;
      state.enabled[i] = on ? -1 : 0;
      state.idle_left[i] = on ? 10.0 : 0.0;
    }
  });
}

void Batch::get_bodies(double* bodies) const {
  for (int environment = 0; environment < n_; ++environment) {
    const Environment state = load(environment);
    for (int i = 0; i < model_.body_count(); ++i, bodies += kBodyState) {
      std::memcpy(bodies, state.position[i], 3 * sizeof(double));
      std::memcpy(bodies + 3, state.quaternion[i], 4 * sizeof(double));
      std::memcpy(bodies + 7, state.velocity[i], 3 * sizeof(double));
      std::memcpy(bodies + 10, state.spin[i], 3 * sizeof(double));
    }
  }
}

void Batch::get_enabled(std::uint8_t* enabled) const {
  for (int environment = 0; environment < n_; ++environment) {
    const Environment state = load(environment);
    for (int i = 0; i < model_.body_count(); ++i) *enabled++ = state.enabled[i] != 0;
  }
}

void Batch::centre_of_mass(double* out) const {
  for (int environment = 0; environment < n_; ++environment) {
    const Environment state = load(environment);
    double sum[3] = {}, mass = 0;
    for (int i = 0; i < model_.body_count(); ++i) {
      const double m = model_.bodies[i].mass;
      mass += m;
      for (int c = 0; c < 3; ++c) sum[c] += m * state.position[i][c];
    }
    for (const double s : sum) *out++ = s / mass;
  }
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

namespace {

// Rows whose centres of mass are computed together.
constexpr int kTogether = 4;
typedef double Wide __attribute__((vector_size(8 * kTogether)));

// Sine and cosine of joint angles. The league's servers print angles with two decimals, so the same ones come again and again: those
// are kept. Every other angle is computed.
class Sines {
 public:
  Sines() : table_(2 * kMost + 1) {
    for (int k = -kMost; k <= kMost; ++k) table_[k + kMost] = of(k / 100.0);
  }

  std::pair<double, double> operator()(double angle_deg) const {
    const double hundredths = std::nearbyint(angle_deg * 100.0);
    if (std::fabs(hundredths) <= kMost && hundredths / 100.0 == angle_deg) return table_[static_cast<int>(hundredths) + kMost];
    return of(angle_deg);
  }

 private:
  static constexpr int kMost = 18000;

  static std::pair<double, double> of(double angle_deg) {
    const double angle = angle_deg * 3.14159265358979323846 / 180.0;
    return {std::sin(angle), std::cos(angle)};
  }

  std::vector<std::pair<double, double>> table_;
};

// Row k is angles_deg + rows[k] * stride, or angles_deg + k * stride without rows.
#if defined(__x86_64__) && defined(__GLIBC__) && !defined(__SANITIZE_ADDRESS__)
__attribute__((target_clones("avx2", "default")))
#endif
void centres_of_mass(const Model& model, const double* angles_deg, std::ptrdiff_t stride, const std::int64_t* rows, int count, double* out) {
  static const Sines sines;
  struct Pose {
    Wide r[9], x[3];
  };
  const int bodies = model.body_count();
  Pose pose[kMaxBodies];
  for (int first = 0; first < count; first += kTogether) {
    const int lanes = std::min(kTogether, count - first);
    const double* angles[kTogether];
    for (int lane = 0; lane < kTogether; ++lane) {
      const int k = first + (lane < lanes ? lane : 0);
      angles[lane] = angles_deg + (rows == nullptr ? k : rows[k]) * stride;
    }
    double mass = 0;
    Wide sum[3] = {};
    for (int i = 0; i < bodies; ++i) {
      const Body& body = model.bodies[i];
      Pose& p = pose[i];
      if (body.parent < 0) {
        p = {};
        p.r[0] = p.r[4] = p.r[8] = Wide{} + 1.0;
      } else {
        const Pose& q = pose[body.parent];
        Wide c, s;
        for (int lane = 0; lane < kTogether; ++lane) {
          const auto [sine, cosine] = sines(angles[lane][body.joint]);
          s[lane] = sine;
          c[lane] = cosine;
        }
        const Wide v = 1.0 - c;
        const double* u = body.axis;
        const Wide turn[9] = {c + u[0] * u[0] * v,        u[0] * u[1] * v - u[2] * s, u[0] * u[2] * v + u[1] * s,
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
    for (int a = 0; a < 3; ++a) sum[a] /= mass;
    for (int lane = 0; lane < lanes; ++lane)
      for (int a = 0; a < 3; ++a) out[3 * (first + lane) + a] = sum[a][lane];
  }
}

void centres_of_mass_for_others(const void* model, const double* angles_deg, std::ptrdiff_t stride, const std::int64_t* rows, int count, double* out) {
  centres_of_mass(*static_cast<const Model*>(model), angles_deg, stride, rows, count, out);
}

}  // namespace

void centre_of_mass_from_angles(const Model& model, const double* angles_deg, int n, double* out) {
  centres_of_mass(model, angles_deg, model.joint_count(), nullptr, n, out);
}

}  // namespace naosim
