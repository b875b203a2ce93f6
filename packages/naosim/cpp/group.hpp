// The state of one environment, and of a group of environments that share vector registers.
#pragma once
#include "model.hpp"

namespace naosim {

constexpr int kLimbs = 4;  // right arm, left arm, right leg, left leg
constexpr double kNeverFrozen = -1000.0;

// What the perceptors measured at the end of one cycle, before rounding.
template <class Real>
struct PerceptorsOf {
  Real joint_angle[kMaxBodies - 1];  // degrees, joint order
  Real gyro[3];                      // degrees/s, torso frame
  Real accel[3];                     // m/s^2, torso frame
  Real touch[kTouchSensors][6];      // point (m) and force (N) in the foot frame; NaN without contact
  Real time;                         // s
};

// Written once for plain numbers (one environment) and vectors (a group, one environment a lane). All members are arrays of
// 8-byte words, so word k of lane l of a group is word k of that environment.
template <class Real, class Mask>
struct StateOf {
  Real position[kMaxBodies][3];    // m, world
  Real quaternion[kMaxBodies][4];  // w x y z
  Real velocity[kMaxBodies][3];    // m/s
  Real spin[kMaxBodies][3];        // rad/s, world
  Real force[kMaxBodies][3];       // N, not yet consumed by a step (a sleeping body keeps it)
  Real torque[kMaxBodies][3];      // N m
  Real angle[kMaxBodies];          // rad, hinge to the parent
  Real motor_speed[kMaxBodies];    // rad/s, persists until the next command
  Real row_side[kMaxBodies];       // last active set of the motor or stop row: -1 lower bound, 0 free, 1 upper bound
  Real limit[kMaxBodies];          // -1 at the low stop, 1 at the high stop, 0 between
  Real idle_left[kMaxBodies];      // quiet steps until the body falls asleep
  Mask enabled[kMaxBodies];        // not asleep
  Mask lifted[kMaxColliders];      // last active set of the contacts, one bit a corner: normal row at its lower bound
  Real frozen_at[kLimbs];          // game time of the last self-collision, s, or kNeverFrozen
  Mask frozen[kLimbs];             // effectors disabled
  Real previous_velocity[3];       // torso velocity at the last accelerometer sample
  Real cycle;                      // cycles since the spawn
  Real game_time;                  // s, summed up in single precision as the server does
  PerceptorsOf<Real> perceptors;       // built at the end of the last cycle
  PerceptorsOf<Real> sent_perceptors;  // sent with the reply to the last command
};

using Environment = StateOf<double, std::int64_t>;
constexpr std::size_t kWords = sizeof(Environment) / sizeof(double);

struct Statistics {
  std::uint64_t steps = 0, solves = 0, fallback = 0;  // groups stepped, linear solves, single-pivot rounds
};

// Compiled once per instruction set; chosen at run time. A `group` is kWords vectors of `lanes` words.
struct Kernel {
  const char* name;
  int lanes;
  // Run one cycle in the lanes of `chosen` (bit l = lane l). `command`: (joints, lanes), rad/s.
  // Returns the lanes whose complementarity problem did not settle (never seen; checked all the same).
  unsigned (*step)(const Model&, void* group, const double* command, unsigned chosen, bool self_collision, Statistics&);
  // Recompute hinge angles and the gyro of `chosen` after their poses were set from outside.
  void (*refresh)(const Model&, void* group, unsigned chosen);
};
const Kernel& best_kernel();
const Kernel* find_kernel(const char* name);

}  // namespace naosim
