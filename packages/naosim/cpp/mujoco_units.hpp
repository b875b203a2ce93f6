// Conversions between numbers and rcssservermj's text, shared by embedded worlds and clients so that both agree to the
// bit.
#pragma once
#include <cmath>

namespace naosim::mujoco {

constexpr double kDegrees = 180.0 / 3.14159265358979323846;  // numpy.degrees
constexpr double kRadians = 3.14159265358979323846 / 180.0;  // math.radians, with which the server reads a command
constexpr double kCommandUnits = 1e4;

// A target angle as it is sent: four decimals of a degree. Adding 0 turns -0 into 0.
inline double command_degrees(double radians) { return std::nearbyint(radians * kDegrees * kCommandUnits) / kCommandUnits + 0.0; }

// Rotation matrix, row by row, of a quaternion w x y z of any length.
inline void rotation_of(const double q[4], double out[9]) {
  const double squared = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
  const double s = squared > 0.0 ? 2.0 / squared : 0.0;
  const double w = q[0], x = q[1], y = q[2], z = q[3];
  const double m[9] = {1 - s * (y * y + z * z), s * (x * y - w * z),     s * (x * z + w * y),
                       s * (x * y + w * z),     1 - s * (x * x + z * z), s * (y * z - w * x),
                       s * (x * z - w * y),     s * (y * z + w * x),     1 - s * (x * x + y * y)};
  for (int k = 0; k < 9; ++k) out[k] = m[k];
}

}  // namespace naosim::mujoco
