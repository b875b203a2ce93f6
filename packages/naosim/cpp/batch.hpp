// Many independent environments stepped together in groups that share vector registers; groups spread over threads that stay alive.
#pragma once
#include <atomic>
#include <cstddef>
#include <limits>
#include <map>
#include <memory>
#include <new>
#include <vector>

#include "group.hpp"
#include "thread_pool.hpp"

namespace naosim {

// Arrays of one row per environment, overwritten in place by every step.
struct BatchArrays {
  std::vector<double> joint_angles;  // (n, joints)
  std::vector<double> gyro, accel;   // (n, 3)
  std::vector<double> touch[kTouchSensors];  // (n, 6)
  std::vector<double> time;                  // (n,)
  std::vector<double> torso_position;        // (n, 3)
  std::vector<double> torso_rotation;        // (n, 3, 3)
};

// The function below for other modules, which get the address of such a table. Row k is angles_deg + rows[k] * stride.
struct Kinematics {
  const void* model;
  void (*centre_of_mass)(const void* model, const double* angles_deg, std::ptrdiff_t stride, const std::int64_t* rows, int count, double* out);
};

class Batch {
 public:
  static constexpr int kBodyState = 13;  // position, quaternion wxyz, velocity, angular velocity

  Batch(Model model, int n, int threads, int digits, bool self_collision, const Kernel& kernel);

  int size() const { return n_; }
  const Model& model() const { return model_; }
  const Kernel& kernel() const { return kernel_; }
  BatchArrays& arrays() { return out_; }
  Statistics statistics() const;
  const Threads* threads() const { return pool_.table(); }
  const Kinematics* kinematics() const { return &kinematics_; }

  // `lanes` below: one byte an environment, or nullptr for all.
  // Returns the first environment whose state is no longer finite or whose equations did not settle, or -1.
  int step(const double* speeds, const std::uint8_t* lanes);
  // Drive the joints to target angles by a proportional controller: speed = gain * (target - perceived angle), (n, joints) rad, limited to
  // max_speed, (joints,) rad/s. Returns kNotFinite, and steps nothing, if a target or perceived angle is not finite.
  int drive(const double* targets, double gain, const double* max_speed, const std::uint8_t* lanes);
  static constexpr int kNotFinite = -2;
  // The same for the environments [first, first + count), both multiples of kWhole unless they end with the last one, in the background:
  // returns kNotFinite or -1 at once; finish_drive(first) returns what drive does.
  int begin_drive(const double* targets, double gain, const double* max_speed, int first, int count);
  int finish_drive(int first);
  static constexpr int kWhole = 8;  // lanes of the widest kernel, so that these are whole groups on every processor
  void reset(const std::uint8_t* lanes);
  void beam(const double* position, const double* yaw_deg, const std::uint8_t* lanes);  // (n, 3), (n,)
  void set_bodies(const double* bodies, const std::uint8_t* lanes);                    // (n, bodies, 13)
  void set_enabled(const std::uint8_t* enabled, const std::uint8_t* lanes);            // (n, bodies)
  void get_bodies(double* bodies) const;
  void get_enabled(std::uint8_t* enabled) const;
  void centre_of_mass(double* out) const;  // (n, 3), world
  Environment load(int environment) const;                 // gather one environment's words
  void restore(int environment, const Environment& state);  // scatter them again and publish

 private:
  double* group(int index) const { return words_.get() + static_cast<std::size_t>(index) * kWords * lanes_; }
  void gather(int environment, std::size_t first, std::size_t count, void* to) const;
  void store(int environment, const Environment& state);
  unsigned lanes_of(int group, const std::uint8_t* lanes) const;
  struct Cycle {
    Round round;
    std::vector<double> targets, max_speed;
    bool running = false;
    std::atomic<int> bad{kNone};
    int result() const { return bad == kNone ? -1 : bad.load(); }
  };
  static constexpr int kNone = std::numeric_limits<int>::max();
  template <class Command>
  int run(const std::uint8_t* lanes, Command command);
  template <class Command>
  void step_group(int index, const std::uint8_t* lanes, const Command& command, std::atomic<int>& bad);
  bool finite(const double* targets, int row) const;
  template <class Change>
  void edit(const std::uint8_t* lanes, Change change);
  Environment spawned() const;
  void publish(int environment);
  double printed(double value) const;

  Model model_;
  int n_;
  double scale_;  // 10^digits, or 0 for full precision
  bool self_collision_;
  const Kernel& kernel_;
  int lanes_, groups_;
  struct Free {
    void operator()(double* p) const { ::operator delete[](p, std::align_val_t{64}); }
  };
  std::unique_ptr<double[], Free> words_;
  std::vector<Statistics> statistics_;
  BatchArrays out_;
  std::map<int, Cycle> cycles_;  // in the background, by their first environment
  ThreadPool pool_;              // after what its helpers use
  Kinematics kinematics_;
};

// Centre of mass in the torso's frame from joint angles in degrees, (n, joints) -> (n, 3).
void centre_of_mass_from_angles(const Model& model, const double* angles_deg, int n, double* out);

}  // namespace naosim
