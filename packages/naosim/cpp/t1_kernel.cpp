// One substep of a group of T1s, compiled once per instruction set: gather, compute, scatter.
#include <cmath>
#include <cstdlib>
#include <memory>
#include <new>

#include "t1_solver.hpp"

namespace naosim::t1::NAOSIM_ISA {

namespace {

// Where a T1's sensors are in sensordata.
constexpr int kQuaternion = 0, kPlace = 4, kGyro = 7, kAccelerometer = 10, kAngles = 13, kRates = kAngles + kJoints, kFeet = kRates + kJoints;

struct Everything {
  Group group;
  Work work;
};

// One for each thread, aligned for vectors.
Everything& everything() {
  struct Free {
    void operator()(Everything* p) const { std::free(p); }
  };
  thread_local std::unique_ptr<Everything, Free> own;
  if (!own) {
    void* memory = std::aligned_alloc(64, (sizeof(Everything) + 63) / 64 * 64);
    if (memory == nullptr) throw std::bad_alloc();
    own.reset(new (memory) Everything());
  }
  return *own;
}

// Sensors of the state before the substep, as mj_step leaves them.
void sense(const Group& g, const Work& w, const Mask ready, Robot* const* robots, int count) {
  const Real* q = g.qpos + 3;
  const Real n = 1.0 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  // the accelerometer measures R^T (dv/dt - g) at the torso's origin
  const Vec felt = inverse_rotate(w.rot[0], Vec{w.a[0], w.a[1], w.a[2] - w.numbers.gravity});
  Vec feet[2] = {zero_vec(), zero_vec()};
  for (int i = 0; i < w.npt; ++i) {
    const Point& p = w.pt[i];
    if (p.body != kLeftFoot && p.body != kRightFoot) continue;
    const Real m1 = p.mu * p.u1, m2 = p.mu * p.u2, z = splat(0);
    const auto force = [&](Mask active, Real j) { return select(active, -p.d * j, z); };
    const Real f0 = force(p.active[0], p.un + m1), f1 = force(p.active[1], p.un - m1), f2 = force(p.active[2], p.un + m2), f3 = force(p.active[3], p.un - m2);
    const Real c1 = p.mu * (f0 - f1), c2 = p.mu * (f2 - f3);
    Vec& foot = feet[p.body == kRightFoot];
    foot = foot + Vec{p.tx * c1 - p.ty * c2, p.ty * c1 + p.tx * c2, f0 + f1 + f2 + f3};
  }
  for (int l = 0; l < count; ++l) {
    if (!ready[l]) continue;
    double* s = robots[l]->sensordata;
    for (int k = 0; k < 4; ++k) s[kQuaternion + k] = q[k][l] * n[l];
    for (int k = 0; k < 3; ++k) s[kPlace + k] = g.qpos[k][l], s[kGyro + k] = g.qvel[3 + k][l];
    s[kAccelerometer] = felt.x[l], s[kAccelerometer + 1] = felt.y[l], s[kAccelerometer + 2] = felt.z[l];
    for (int j = 0; j < kJoints; ++j) s[kAngles + j] = g.qpos[7 + j][l], s[kRates + j] = g.qvel[6 + j][l];
    for (int f = 0; f < 2; ++f) s[kFeet + 3 * f] = feet[f].x[l], s[kFeet + 3 * f + 1] = feet[f].y[l], s[kFeet + 3 * f + 2] = feet[f].z[l];
  }
}

// What robots of a group should have alike: self contacts, feet on the floor, iterations.
void classify(const Work& w, Robot* const* robots, int count) {
  Mask pairs = Mask{}, left = Mask{}, right = Mask{};
  for (int i = 0; i < w.npr; ++i) pairs |= w.pr[i].exists;
  for (int i = 0; i < w.npt; ++i) {
    if (w.pt[i].body == kLeftFoot) left |= w.pt[i].exists;
    if (w.pt[i].body == kRightFoot) right |= w.pt[i].exists;
  }
  for (int l = 0; l < count; ++l)
    robots[l]->key = (pairs[l] ? 1024 : 0) + (left[l] ? 512 : 0) + (right[l] ? 256 : 0) + w.iterations[l];
}

void substep(const Shared& m, Robot* const* robots, int count) {
  Everything& all = everything();
  Group& g = all.group;
  Work& w = all.work;
  for (int l = 0; l < kLanes; ++l) {  // lanes without a robot repeat the first
    const Robot& robot = *robots[l < count ? l : 0];
    const double* numbers = reinterpret_cast<const double*>(robot.numbers);
    Real* to = reinterpret_cast<Real*>(&w.numbers);
    for (std::size_t k = 0; k < sizeof(Varied) / sizeof(double); ++k) to[k][l] = numbers[k];
    for (int k = 0; k < kPositions; ++k) g.qpos[k][l] = robot.qpos[k];
    for (int k = 0; k < kSpeeds; ++k) g.qvel[k][l] = robot.qvel[k], g.warm[k][l] = robot.warm[k];
    for (int j = 0; j < kJoints; ++j) g.target[j][l] = robot.ctrl[3 * j + 1];
  }
  kinematics(m, g, w);
  forces(m, g, w);
  inertia(m, w);
  collide(m, g, w);
  newton(m, g, w);
  Group before = g;
  integrate(m, g, w);
  Real sum = splat(0);
  for (int k = 0; k < kPositions; ++k) sum += abs(g.qpos[k]);
  for (int k = 0; k < kSpeeds; ++k) sum += abs(g.qvel[k]) + abs(g.warm[k]);
  const Mask ready = ~w.flagged & (sum < 1e9);  // false for NaN
  sense(before, w, ready, robots, count);
  classify(w, robots, count);
  for (int l = 0; l < count; ++l) {
    Robot& robot = *robots[l];
    robot.settled = ready[l] != 0;
    if (!robot.settled) continue;
    for (int k = 0; k < kPositions; ++k) robot.qpos[k] = g.qpos[k][l];
    for (int k = 0; k < kSpeeds; ++k) robot.qvel[k] = g.qvel[k][l], robot.warm[k] = g.warm[k][l];
  }
}

}  // namespace

#define NAOSIM_NAME_(x) #x
#define NAOSIM_NAME(x) NAOSIM_NAME_(x)
extern const Kernel kernel;
const Kernel kernel = {NAOSIM_NAME(NAOSIM_ISA), kLanes, substep};

}  // namespace naosim::t1::NAOSIM_ISA
