// One substep of a group of humanoids, compiled once per instruction set: gather, compute, scatter.
#include <cmath>
#include <cstdlib>
#include <memory>
#include <new>

#include "humanoid_solver.hpp"

namespace naosim::NAOSIM_ROBOT::NAOSIM_ISA {

namespace {

// Where sensors are in sensordata.
constexpr int kQuaternion = 0, kPlace = 4, kGyro = 7, kAccelerometer = 10, kAngles = 13, kRates = kAngles + kJoints, kFeet = kRates + kJoints, kTouching = kFeet + 6;

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
void sense(const Shared& m, const Group& g, const Work& w, const Mask ready, Robot* const* robots, int count) {
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
  if (w.speeds == kSpeeds) return;
  const int camera = int(m.ball.camera), parts = int(m.ball.count);
  const Vec seen = inverse_rotate(times(w.rot[camera], m.ball.turn), w.ball - w.r[camera] - rotate(w.rot[camera], m.ball.place));
  for (int l = 0; l < count; ++l) {
    if (!ready[l]) continue;
    double* s = robots[l]->sensordata + kTouching;
    for (int part = 0; part < parts; ++part) s[part] = -static_cast<double>(w.touching[part][l]);
    s[parts] = seen.x[l], s[parts + 1] = seen.y[l], s[parts + 2] = seen.z[l];
  }
}

// What robots of a group should have alike: self contacts, feet on the floor, iterations.
void classify(const Work& w, Robot* const* robots, int count) {
  Mask pairs = w.searched, left = Mask{}, right = Mask{};
  for (int i = 0; i < w.npr; ++i) pairs |= w.pr[i].exists;
  for (int i = 0; i < w.npt; ++i) {
    if (w.pt[i].body == kLeftFoot) left |= w.pt[i].exists;
    if (w.pt[i].body == kRightFoot) right |= w.pt[i].exists;
  }
  for (int l = 0; l < count; ++l)
    robots[l]->key = (pairs[l] ? 1024 : 0) + (left[l] ? 512 : 0) + (right[l] ? 256 : 0) + w.iterations[l];
}

void substep(const void* shared, const Library& mujoco, Robot* const* robots, int count) {
  const Shared& m = *static_cast<const Shared*>(shared);
  Everything& all = everything();
  Group& g = all.group;
  Work& w = all.work;
  const bool with_ball = m.ball.exists != 0.0;
  for (int l = 0; l < kLanes; ++l) {  // lanes without a robot repeat the first
    const Robot& robot = *robots[l < count ? l : 0];
    const double* numbers = static_cast<const double*>(robot.numbers);
    Real* to = reinterpret_cast<Real*>(&w.numbers);
    for (std::size_t k = 0; k < sizeof(Varied) / sizeof(double); ++k) to[k][l] = numbers[k];
    for (int k = 0; k < kPositions; ++k) g.qpos[k][l] = robot.qpos[k];
    for (int k = 0; k < kSpeeds; ++k) g.qvel[k][l] = robot.qvel[k], g.warm[k][l] = robot.warm[k];
    for (int j = 0; j < kJoints; ++j) g.target[j][l] = robot.ctrl[3 * j + 1];
    for (int k = 0; k < 7 && with_ball; ++k) g.ball[k][l] = robot.ball_qpos[k];
    for (int k = 0; k < 6 && with_ball; ++k) g.qvel[kSpeeds + k][l] = robot.ball_qvel[k], g.warm[kSpeeds + k][l] = robot.ball_warm[k];
  }
  w.speeds = with_ball ? kAll : kSpeeds;
  if (with_ball) {  // its spins from its axes into the world's
    const Rot r = rotation_of(g.ball + 3);
    for (Real* spin : {g.qvel + kSpeeds + 3, g.warm + kSpeeds + 3}) store(spin, r * load(spin));
  }
  kinematics(m, g, w);
  forces(m, g, w);
  inertia(m, w);
  collide(m, mujoco, robots, count, g, w);
  newton(m, g, w);
  Group before = g;
  integrate(m, g, w);
  Real sum = splat(0);
  for (int k = 0; k < kPositions; ++k) sum += abs(g.qpos[k]);
  for (int k = 0; k < w.speeds; ++k) sum += abs(g.qvel[k]) + abs(g.warm[k]);
  for (int k = 0; k < 7 && with_ball; ++k) sum += abs(g.ball[k]);
  if (with_ball) {
    const Rot r = w.ball_rot;
    for (Real* spin : {g.qvel + kSpeeds + 3, g.warm + kSpeeds + 3}) store(spin, inverse_rotate(r, load(spin)));
  }
  const Mask ready = ~w.flagged & (sum < 1e9);  // false for NaN
  sense(m, before, w, ready, robots, count);
  classify(w, robots, count);
  for (int l = 0; l < count; ++l) {
    Robot& robot = *robots[l];
    robot.settled = ready[l] != 0;
    robot.collided = w.searched[l] != 0;
    if (!robot.settled) continue;
    for (int k = 0; k < kPositions; ++k) robot.qpos[k] = g.qpos[k][l];
    for (int k = 0; k < kSpeeds; ++k) robot.qvel[k] = g.qvel[k][l], robot.warm[k] = g.warm[k][l];
    for (int k = 0; k < 7 && with_ball; ++k) robot.ball_qpos[k] = g.ball[k][l];
    for (int k = 0; k < 6 && with_ball; ++k) robot.ball_qvel[k] = g.qvel[kSpeeds + k][l], robot.ball_warm[k] = g.warm[kSpeeds + k][l];
  }
}

}  // namespace

#define NAOSIM_NAME_(x) #x
#define NAOSIM_NAME(x) NAOSIM_NAME_(x)
extern const humanoid::Kernel kernel;
const humanoid::Kernel kernel = {
    NAOSIM_NAME(NAOSIM_ISA), kLanes, {kBodies, kGeoms, kParent, kAxis, kGeomBody, kGeomShape}, sizeof(Shared), sizeof(Varied), substep};

}  // namespace naosim::NAOSIM_ROBOT::NAOSIM_ISA
