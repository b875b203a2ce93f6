// One substep of a group of humanoids, compiled once per instruction set: gather, compute, scatter.
#include <cmath>
#include <cstdlib>
#include <cstring>
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
  std::uint64_t versions[kLanes];  // of the numbers in the lanes
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

// States and numbers of robots, one in each lane; lanes without a robot repeat the first.
void gather(const Shared& m, Robot* const* robots, int count, Everything& all) {
  Group& g = all.group;
  Work& w = all.work;
  const bool with_ball = m.ball.exists != 0.0;
  for (int l = 0; l < kLanes; ++l) {
    const Robot& robot = *robots[l < count ? l : 0];
    if (all.versions[l] != robot.version) {
      const double* numbers = static_cast<const double*>(robot.numbers);
      Real* to = reinterpret_cast<Real*>(&w.numbers);
      for (std::size_t k = 0; k < sizeof(Varied) / sizeof(double); ++k) to[k][l] = numbers[k];
      all.versions[l] = robot.version;
    }
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
}

// The robots' memory of a row, bit by bit: rows of a pyramid 1 to 8; zones of joint friction 1 and 2; known 16.
typedef std::uint8_t Bytes __attribute__((vector_size(kLanes)));

void recall(Robot* const* robots, int count, Work& w) {
  const auto memory = [&](int row) {
    Bytes bytes{};
    for (int l = 0; l < count; ++l) bytes[l] = robots[l]->active[row];
    return __builtin_convertvector(bytes, Mask);
  };
  const auto pyramid = [&](Pyramid& p) {
    const Mask known = memory(p.row);
    for (int k = 0; k < 4; ++k) p.active[k] = (known & 1 << k) != 0;
    // what a lane no longer touches is forgotten: it is here only if a neighbour touches it
    p.known = ((known & 16) != 0) & p.exists;
  };
  for (int i = 0; i < w.npt; ++i) pyramid(w.pt[i]);
  for (int i = 0; i < w.npr; ++i) pyramid(w.pr[i]);
  for (int j = 0; j < kJoints; ++j) {
    const Mask known = memory(joint_row(j));
    w.zone[j][0] = (known & 1) != 0, w.zone[j][1] = (known & 2) != 0, w.zone_known[j] = (known & 16) != 0;
  }
}

void remember(Robot* const* robots, int count, const Work& w) {
  for (int l = 0; l < count; ++l) std::memset(robots[l]->active, 0, kRows);
  const auto keep = [&](int row, Mask value) {
    const Bytes bytes = __builtin_convertvector(value, Bytes);
    for (int l = 0; l < count; ++l) robots[l]->active[row] = bytes[l];
  };
  const auto pyramid = [&](const Pyramid& p) {
    keep(p.row, (p.active[0] & 1) | (p.active[1] & 2) | (p.active[2] & 4) | (p.active[3] & 8) | (p.exists & 16));
  };
  for (int i = 0; i < w.npt; ++i) pyramid(w.pt[i]);
  for (int i = 0; i < w.npr; ++i) pyramid(w.pr[i]);
  for (int j = 0; j < kJoints; ++j) keep(joint_row(j), (w.zone[j][0] & 1) | (w.zone[j][1] & 2) | 16);
}

// Sensors of the state before the substep, as mj_step leaves them; without `last`, forces on the feet and contacts with the ball only.
void sense(const Shared& m, const Group& g, const Work& w, Robot* const* robots, int count, bool last) {
  Vec feet[2] = {zero_vec(), zero_vec()};
  for (int i = 0; i < w.npt; ++i) {
    const Point& p = w.pt[i];
    if (p.body != kLeftFoot && p.body != kRightFoot) continue;
    const Real mt = p.mu * p.ut, ms = p.mu * p.us, z = splat(0);
    const auto force = [&](Mask active, Real x) { return select(active, -p.d * x, z); };
    const Real f0 = force(p.active[0], p.un + mt), f1 = force(p.active[1], p.un - mt), f2 = force(p.active[2], p.un + ms), f3 = force(p.active[3], p.un - ms);
    const Real c1 = p.mu * (f0 - f1), c2 = p.mu * (f2 - f3);
    Vec& foot = feet[p.body == kRightFoot];
    foot = foot + Vec{p.tx * c1 - p.ty * c2, p.ty * c1 + p.tx * c2, f0 + f1 + f2 + f3};
  }
  for (int l = 0; l < count; ++l) {
    double* s = robots[l]->sensordata;
    for (int f = 0; f < 2; ++f) s[kFeet + 3 * f] = feet[f].x[l], s[kFeet + 3 * f + 1] = feet[f].y[l], s[kFeet + 3 * f + 2] = feet[f].z[l];
    for (int part = 0; w.speeds == kAll && part < int(m.ball.count); ++part) s[kTouching + part] = -static_cast<double>(w.touching[part][l]);
  }
  if (!last) return;
  const Real* q = g.qpos + 3;
  const Real n = 1.0 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  // the accelerometer measures R^T (dv/dt - g) at the torso's origin
  const Vec felt = inverse_rotate(w.rot[0], Vec{w.a[0], w.a[1], w.a[2] - w.numbers.gravity});
  for (int l = 0; l < count; ++l) {
    double* s = robots[l]->sensordata;
    for (int k = 0; k < 4; ++k) s[kQuaternion + k] = q[k][l] * n[l];
    for (int k = 0; k < 3; ++k) s[kPlace + k] = g.qpos[k][l], s[kGyro + k] = g.qvel[3 + k][l];
    s[kAccelerometer] = felt.x[l], s[kAccelerometer + 1] = felt.y[l], s[kAccelerometer + 2] = felt.z[l];
    for (int j = 0; j < kJoints; ++j) s[kAngles + j] = g.qpos[7 + j][l], s[kRates + j] = g.qvel[6 + j][l];
  }
  if (w.speeds == kSpeeds) return;
  const int camera = int(m.ball.camera);
  const Vec seen = inverse_rotate(times(w.rot[camera], m.ball.turn), w.ball - w.r[camera] - rotate(w.rot[camera], m.ball.place));
  for (int l = 0; l < count; ++l) {
    double* s = robots[l]->sensordata + kTouching + int(m.ball.count);
    s[0] = seen.x[l], s[1] = seen.y[l], s[2] = seen.z[l];
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

void substep(const void* shared, const Library& mujoco, Robot* const* robots, int count, bool last) {
  const Shared& m = *static_cast<const Shared*>(shared);
  Everything& all = everything();
  Group& g = all.group;
  Work& w = all.work;
  gather(m, robots, count, all);
  kinematics(m, g, w);
  velocities(g, w);
  inertias(w);
  forces(m, g, w);
  inertia(m, w);
  collide(m, mujoco, robots, count, g, w);
  recall(robots, count, w);
  newton(m, g, w);
  // of a lane that is not ready below, mj_step overwrites all that is left here
  remember(robots, count, w);
  classify(w, robots, count);
  sense(m, g, w, robots, count, last);
  integrate(m, g, w);
  const bool with_ball = w.speeds == kAll;
  Real sum = splat(0);
  for (int k = 0; k < kPositions; ++k) sum += abs(g.qpos[k]);
  for (int k = 0; k < w.speeds; ++k) sum += abs(g.qvel[k]) + abs(g.warm[k]);
  for (int k = 0; k < 7 && with_ball; ++k) sum += abs(g.ball[k]);
  if (with_ball)
    for (Real* spin : {g.qvel + kSpeeds + 3, g.warm + kSpeeds + 3}) store(spin, inverse_rotate(w.ball_rot, load(spin)));
  const Mask ready = ~w.flagged & (sum < 1e9);  // false for NaN
  for (int l = 0; l < count; ++l) {
    Robot& robot = *robots[l];
    robot.settled = ready[l] != 0;
    robot.collided = w.searched[l] != 0;
    if (!robot.settled) {
      std::memset(robot.active, 0, kRows);
      continue;
    }
    for (int k = 0; k < kPositions; ++k) robot.qpos[k] = g.qpos[k][l];
    for (int k = 0; k < kSpeeds; ++k) robot.qvel[k] = g.qvel[k][l], robot.warm[k] = g.warm[k][l];
    for (int k = 0; k < 7 && with_ball; ++k) robot.ball_qpos[k] = g.ball[k][l];
    for (int k = 0; k < 6 && with_ball; ++k) robot.ball_qvel[k] = g.qvel[kSpeeds + k][l], robot.ball_warm[k] = g.warm[kSpeeds + k][l];
  }
}

void motion(const void* shared, Robot* const* robots, int count, const int* bodies, int number, double* out) {
  const Shared& m = *static_cast<const Shared*>(shared);
  Everything& all = everything();
  const Group& g = all.group;
  Work& w = all.work;
  gather(m, robots, count, all);
  kinematics(m, g, w);
  velocities(g, w);
  const Vec torso = load(g.qpos);
  for (int i = 0; i < number; ++i) {
    const int b = bodies[i];
    const Rot& r = b == kBall ? w.ball_rot : w.rot[b];
    const Vec spin = b == kBall ? load(g.qvel + kSpeeds + 3) : w.vel[b].w;
    const Vec speed = b == kBall ? load(g.qvel + kSpeeds) : velocity_at(w.vel[b], w.r[b]);
    const Vec place = b == kBall ? load(g.ball) : torso + w.r[b];
    const Real all_of[kMotion] = {place.x, place.y, place.z, r.m[0][0], r.m[0][1], r.m[0][2], r.m[1][0], r.m[1][1], r.m[1][2],
                                  r.m[2][0], r.m[2][1], r.m[2][2], speed.x, speed.y, speed.z, spin.x, spin.y, spin.z};
    for (int l = 0; l < count; ++l)
      for (int k = 0; k < kMotion; ++k) out[(l * number + i) * kMotion + k] = all_of[k][l];
  }
}

}  // namespace

#define NAOSIM_NAME_(x) #x
#define NAOSIM_NAME(x) NAOSIM_NAME_(x)
extern const humanoid::Kernel kernel;
const humanoid::Kernel kernel = {
    NAOSIM_NAME(NAOSIM_ISA), kLanes, {kBodies, kGeoms, kParent, kAxis, kGeomBody, kGeomShape}, sizeof(Shared), sizeof(Varied), kRows, substep, motion};

}  // namespace naosim::NAOSIM_ROBOT::NAOSIM_ISA
