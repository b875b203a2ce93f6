// The engine that steps several humanoids of one kind at once, as the loop of worlds sees it.
//
// It is compiled for each robot, whose tree is known at compile time, and for each instruction set. All numbers come from the
// robot's MjModel, read by naosim.mujoco.humanoid.
#pragma once
#include <cstddef>
#include <cstdint>

namespace naosim::humanoid {

// MuJoCo's constraint parameters of one kind of row: impedance d0 to d1 over `width`, aref = -b v - k imp dist.
struct Impedance {
  double d0, d1, width, k, b;
};

// The tree of a robot. Body 0 is the torso; body b > 0 hangs on one hinge, whose speed is number 5 + b, about the x, y or z axis
// of its frame. Shapes are MuJoCo's mjtGeom.
struct Topology {
  int bodies, geoms;
  const int *parents, *axes, *geom_bodies, *geom_shapes;
};

struct Robot;

// What the kernels use of MuJoCo for contacts that they do not compute.
struct Library {
  void (*collide)(void* worlds, const Robot& robot);  // find the contacts of the robot's mjData
  void* worlds;
  double step;                 // s
  int first_geom, ball;        // the robot's first geom, the ball's; -1 without a ball
};

// One robot as the kernel sees it: its numbers and the arrays of its mjData. The ball's arrays are null where there is none.
struct Robot {
  const void* numbers;    // Varied of humanoid_model.hpp
  std::uint64_t version;  // of the numbers: robots with the same version have the same numbers
  unsigned char* active;  // Kernel::rows bytes: rows of the solver that were active in the last substep; 0: unknown
  double *qpos, *qvel, *warm, *sensordata;
  const double* ctrl;
  double *ball_qpos, *ball_qvel, *ball_warm;
  void* data;
  int key = 0;            // contacts and iterations of the last substep; alike robots share a group
  bool settled = false;   // false: the kernel has left the robot as it was, and mj_step must take the substep
  bool collided = false;  // MuJoCo found some of its contacts in the last substep
};

constexpr int kMotion = 18;

struct Kernel {
  const char* name;  // of the instruction set
  int lanes;
  Topology topology;
  std::size_t shared, varied, rows;  // bytes
  // Advance `count` <= lanes robots by a substep. Sensors are MuJoCo's: those of the state before the substep; without `last`,
  // only the forces on the feet and what touches the ball.
  void (*substep)(const void* shared, const Library&, Robot* const* robots, int count, bool last);
  // Write position, rotation, velocity and spin of some bodies (number `bodies` of the topology: the ball), world axes: kMotion
  // numbers a body, robot by robot.
  void (*motion)(const void* shared, Robot* const* robots, int count, const int* bodies, int number, double* out);
};

// The kernel for a robot, "t1" or "k1", and an instruction set, or for the best one that runs here if `isa` is null; null: none.
const Kernel* find_kernel(const char* robot, const char* isa);

}  // namespace naosim::humanoid
