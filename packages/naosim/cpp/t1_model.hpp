// The T1's tree, known at compile time, and its numbers, read from the MjModel by naosim.mujoco.t1.
#pragma once
#include <cstddef>

namespace naosim::t1 {

constexpr int kBodies = 24, kSpeeds = 29, kJoints = 23, kGeoms = 12, kPositions = 30;
constexpr int kEntries = kSpeeds * (kSpeeds + 1) / 2;  // of a packed lower triangle
inline constexpr int at(int i, int j) { return i * (i + 1) / 2 + j; }

// Body 0 is the torso; body b > 0 hangs on one hinge, whose speed is number 5 + b, about the x, y or z axis of its frame.
constexpr int kParent[kBodies] = {-1, 0, 1, 0, 3, 4, 5, 0, 7, 8, 9, 0, 11, 12, 13, 14, 15, 16, 11, 18, 19, 20, 21, 22};
constexpr int kAxis[kBodies] = {0, 2, 1, 1, 0, 1, 2, 1, 0, 1, 2, 2, 1, 0, 2, 1, 1, 0, 1, 0, 2, 1, 1, 0};
constexpr int kLeftFoot = 17, kRightFoot = 23;

enum Shape { kSphere, kCapsule, kBox };
constexpr int kGeomBody[kGeoms] = {0, 2, 5, 6, 9, 10, 13, 15, 17, 19, 21, 23};
constexpr Shape kGeomShape[kGeoms] = {kBox, kSphere, kCapsule, kCapsule, kCapsule, kCapsule, kCapsule, kCapsule, kBox, kCapsule, kCapsule, kBox};

// MuJoCo's constraint parameters of one kind of row: impedance d0 to d1 over `width`, aref = -b v - k imp dist.
struct Impedance {
  double d0, d1, width, k, b;
};

// Numbers that all robots of a batch share. Doubles only: they come as one array.
struct Shared {
  double step;
  Impedance limit;
  double friction_loss, friction_d0, friction_b;  // N m; friction rows have one impedance
  double density, viscosity;
  double position[kBodies][3], turn[kBodies][9];          // of a body in its parent's frame
  double centre[kBodies][3], principal[kBodies][9];       // of mass; inertial axes, body frame
  double box[kBodies][3];                                 // sides of the box with the body's inertia, for the air
  double armature[kSpeeds], damping[kSpeeds];
  double kp[kJoints], kd[kJoints], torque[kJoints], low[kJoints], high[kJoints];
  double size[kGeoms][3], offset[kGeoms][3], frame[kGeoms][9];
  Impedance floor[kGeoms];
  Impedance pair[kGeoms][kGeoms];
  double collides[kGeoms][kGeoms];  // 1 where MuJoCo's filters let two geoms collide
};

// Numbers that randomisation changes: one robot's doubles, or a group's vectors.
template <class Real>
struct VariedOf {
  Real gravity, scale;                       // scale: 1 / (mean inertia * speeds), MuJoCo's unit of the gradient
  Real mass[kBodies], inertia[kBodies][6];   // xx yy zz xy xz yz about the centre of mass, body axes
  Real weight[kBodies];                      // translational body_invweight0
  Real friction[kGeoms], joint_weight[kJoints];
};
using Varied = VariedOf<double>;

// One robot as the kernel sees it: the arrays of its mjData.
struct Robot {
  const Varied* numbers;
  double *qpos, *qvel, *warm, *sensordata;
  const double* ctrl;
  int key = 0;           // contacts and iterations of the last substep; alike robots share a group
  bool settled = false;  // false: the kernel has left the robot as it was, and mj_step must take the substep
};

// Compiled once per instruction set; chosen at run time.
struct Kernel {
  const char* name;
  int lanes;
  // Advance `count` <= lanes robots by a substep. Sensors are MuJoCo's: those of the state before the substep.
  void (*substep)(const Shared&, Robot* const* robots, int count);
};
const Kernel& best_kernel();
const Kernel* find_kernel(const char* name);

}  // namespace naosim::t1
