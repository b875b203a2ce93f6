// A robot's numbers, read from the MjModel by naosim.mujoco.humanoid in the order of this file.
#pragma once
#include "humanoid.hpp"

namespace naosim::NAOSIM_ROBOT {

using humanoid::Impedance, humanoid::kMotion, humanoid::Library, humanoid::Robot;

enum Shape { kSphere = 2, kCapsule = 3, kCylinder = 5, kBox = 6, kMesh = 7 };  // mjtGeom

#include NAOSIM_TOPOLOGY

constexpr int kJoints = kBodies - 1, kSpeeds = kJoints + 6, kPositions = kJoints + 7;
constexpr int kBall = kBodies, kAll = kSpeeds + 6;     // the ball's number as a body; speeds with the ball's, which come last
constexpr int kEntries = kAll * (kAll + 1) / 2;        // of a packed lower triangle
inline constexpr int at(int i, int j) { return i * (i + 1) / 2 + j; }

constexpr bool is_round(int geom) { return kGeomShape[geom] == kSphere || kGeomShape[geom] == kCapsule; }

// Meshes, and the cells of the table of how far each extends: on a side of the cube of directions, along one edge.
constexpr int meshes_before(int geom) {
  int count = 0;
  for (int k = 0; k < geom; ++k) count += kGeomShape[k] == kMesh;
  return count;
}
constexpr int kMeshes = meshes_before(kGeoms), kCells = 8;

// What the solver remembers of a robot's rows, a byte each: the points at which a geom can touch the floor, the joints' friction,
// and the pairs of spheres and capsules.
constexpr int points_before(int geom) {
  int count = 0;
  for (int k = 0; k < geom; ++k) count += kGeomShape[k] == kBox ? 4 : kGeomShape[k] == kCapsule ? 2 : kGeomShape[k] == kSphere ? 1 : 0;
  return count;
}
constexpr int round_before(int geom) {
  int count = 0;
  for (int k = 0; k < geom; ++k) count += is_round(k);
  return count;
}
constexpr int kPoints = points_before(kGeoms), kRound = round_before(kGeoms), kPairs = kRound * (kRound - 1) / 2;
constexpr int kRows = kPoints + kJoints + kPairs;
constexpr int joint_row(int joint) { return kPoints + joint; }
constexpr int pair_row(int low, int high) { return kPoints + kJoints + round_before(high) * (round_before(high) - 1) / 2 + round_before(low); }

// Numbers that all robots of a batch share. Doubles only: they come as one array.
struct Shared {
  double step, damped;  // damped: 1 if a joint has damping
  Impedance limit;
  double friction_loss, friction_d0, friction_b;  // N m; friction rows have one impedance
  double density, viscosity;
  double position[kBodies][3], turn[kBodies][9];          // of a body in its parent's frame
  double principal[kBodies][9];                           // inertial axes, body frame
  double box[kBodies][3];                                 // sides of the box with the body's inertia, for the air
  double armature[kSpeeds], damping[kSpeeds];
  double torque[kJoints], low[kJoints], high[kJoints];
  double size[kGeoms][3], offset[kGeoms][3], frame[kGeoms][9];
  double hull[kGeoms][3], middle[kGeoms][3];              // half sides and centre, body frame, of the box around a geom
  Impedance floor[kGeoms];
  Impedance pair[kGeoms][kGeoms];
  double collides[kGeoms][kGeoms];  // 1 where MuJoCo's filters let two geoms collide
  struct {
    double exists, radius, mass, inertia, side;  // side: of the box with its inertia
    Impedance floor;
    double friction[5];                          // on the floor: along two tangents, about the normal, about the tangents
    double parts[kBodies];                       // bits of the parts that a body belongs to whose contact is noted
    double count;                                // of parts
    double camera, place[3], turn[9];            // its body, its pose there
  } ball;
  double goals, goal[2][6];  // how many; corners of the box around each
  // how far meshes extend from the middle of their box, times the length of these directions in their axes: sides x, -x, y, -y, z, -z
  // of a cube, on each a grid along the next two axes
  double extent[kMeshes ? kMeshes : 1][6][kCells + 1][kCells + 1];
};

// Numbers that randomisation changes: one robot's doubles, or a group's vectors.
template <class Real>
struct VariedOf {
  Real gravity, scale;                       // scale: 1 / (mean inertia * speeds), MuJoCo's unit of the gradient
  Real mass[kBodies], inertia[kBodies][6];   // xx yy zz xy xz yz about the centre of mass, body axes
  Real centre[kBodies][3];                   // of mass, body frame
  Real weight[kBodies];                      // translational body_invweight0
  Real friction[kGeoms], joint_weight[kJoints];
  Real kp[kJoints], kd[kJoints];             // gains of the motors
  Real stiffness, damping;                   // factors of K and B of the contacts that the kernel finds
};
using Varied = VariedOf<double>;

}  // namespace naosim::NAOSIM_ROBOT
