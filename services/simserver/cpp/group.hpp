// The state of eight environments, one per lane. Every member is an array of 64-byte vectors,
// so lane l of the whole struct is every eighth 8-byte word: that is what a snapshot copies.
#pragma once
#include "lanes.hpp"
#include "model.hpp"

namespace naosim {

constexpr int kLimbs = 4;  // right arm, left arm, right leg, left leg

// What the perceptors measured at the end of one cycle, before rounding.
struct Senses {
  Real joint_angle[kMaxBodies - 1];  // degrees, joint order
  Real gyro[3];                      // degrees/s, torso frame
  Real accel[3];                     // m/s^2, torso frame
  Real touch[kTouchSensors][6];      // point (m) and force (N) in the foot frame; NaN without contact
  Real time;                         // s
};

struct alignas(64) Group {
  Real position[kMaxBodies][3];    // m, world
  Real quaternion[kMaxBodies][4];  // w x y z
  Real velocity[kMaxBodies][3];    // m/s
  Real spin[kMaxBodies][3];        // rad/s, world
  Real force[kMaxBodies][3];       // N, not yet consumed by a step (a sleeping body keeps it)
  Real torque[kMaxBodies][3];      // N m
  Real angle[kMaxBodies];          // rad, hinge to the parent
  Real motor_speed[kMaxBodies];    // rad/s, persists until commanded anew
  Real row_side[kMaxBodies];       // last active set of the motor or stop row: -1 lower bound, 0 free, 1 upper bound
  Real limit[kMaxBodies];          // -1 at the low stop, 1 at the high stop, 0 between
  Real idle_left[kMaxBodies];      // quiet steps until the body falls asleep
  Mask enabled[kMaxBodies];        // not asleep
  Real frozen_at[kLimbs];          // game cycle of the last self-collision, or kNeverFrozen
  Mask frozen[kLimbs];             // effectors disabled
  Real previous_velocity[3];       // torso velocity at the last accelerometer sample
  Real cycle;                      // game clock, in cycles
  Senses sensed;                   // built at the end of the last cycle
  Senses delivered;                // sent with the reply to the last command
};
static_assert(sizeof(Group) % 64 == 0, "whole vectors only");

constexpr double kNeverFrozen = -1e9;

struct Statistics {
  std::uint64_t steps = 0, solves = 0, fallback = 0;  // groups stepped, linear solves, single-pivot rounds
};

// Compiled once per instruction set; chosen at run time.
struct Kernel {
  const char* name;
  // Run one cycle in the lanes of `lanes` (bit l = lane l). `command`: (joints) vectors of rad/s.
  // Returns the lanes whose complementarity problem did not converge (never seen; checked all the same).
  unsigned (*step)(const Model&, Group&, const Real* command, unsigned lanes, bool self_collision, Statistics&);
  // Recompute hinge angles and perceptors of `lanes` after their poses were set from outside.
  void (*refresh)(const Model&, Group&, unsigned lanes, bool touch);
};
const Kernel& best_kernel();
const Kernel* find_kernel(const char* name);

}  // namespace naosim
