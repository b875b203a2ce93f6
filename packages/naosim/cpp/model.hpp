// The robot as the engine needs it: plain numbers, filled from the Python robot tables (naosim.robots).
#pragma once
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

namespace naosim {

constexpr int kMaxBodies = 25;     // 23, and two toes for type 4
constexpr int kMaxColliders = 15;  // every box, the head sphere and the neck capsule
constexpr int kTouchSensors = 4;   // right foot, left foot, right toe, left toe

enum class Shape : int { kNone = 0, kBox = 1, kSphere = 2, kCapsule = 3 };

// A body and the hinge to its parent. Parents come before children; body 0 is the torso.
struct Body {
  double mass;           // kg
  double inertia[3];     // principal moments, kg m^2
  bool isotropic;        // all three equal: no gyroscopic torque
  int parent;            // -1 for the torso
  Shape shape;           // collider
  double half[3];        // box: half lengths, m
  double radius;         // sphere, capsule, m
  double half_length;    // capsule: half its cylinder, m
  double offset[3];      // centre relative to the torso's at angles 0, m
  double anchor[3];      // hinge anchor in this body's frame, m
  double parent_anchor[3];
  double axis[3];        // unit; the same in both frames because all parts spawn axis-parallel
  double low, high;      // stops, rad
  double max_speed;      // rad/s
  int joint;             // index in the robot's joint order
  int limb;              // effectors frozen together by the self-collision rule; -1: none
  int touch;             // touch sensor of this body, or -1
};

struct Model {
  std::vector<Body> bodies;
  std::vector<int> joint_body;                      // joint order -> its own body
  std::vector<std::pair<int, int>> collision_pairs;  // box pairs under the self-collision rule
  int touch_body[kTouchSensors];                    // -1: none
  int body_count() const { return static_cast<int>(bodies.size()); }
  int joint_count() const { return static_cast<int>(joint_body.size()); }
};

}  // namespace naosim
