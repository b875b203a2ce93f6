// Many MuJoCo worlds of one model, stepped together; naosim.mujoco.batch documents the arguments.
//
// The library is the one that the Python package has loaded: the addresses of its functions and of the worlds' arrays are handed
// over, so that neither headers nor a library are needed to build this file.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <map>
#include <mutex>
#include <stdexcept>
#include <string>
#include <vector>

#include "exchange_bindings.hpp"
#include "mujoco_exchange.hpp"
#include "mujoco_units.hpp"
#include "humanoid.hpp"
#include "thread_pool.hpp"

namespace nb = nanobind;

using Doubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Bytes = nb::ndarray<const std::uint8_t, nb::c_contig, nb::device::cpu>;
using Addresses = nb::ndarray<const std::uint64_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Output = nb::ndarray<double, nb::c_contig, nb::device::cpu>;

using naosim::mujoco::command_degrees, naosim::mujoco::kDegrees, naosim::mujoco::kRadians, naosim::mujoco::rotation_of;
using naosim::humanoid::Kernel, naosim::protocol::MujocoExchange;

namespace {

// mujoco.h of 3.5.0
using Step = void (*)(const void* model, void* data);
using SetState = void (*)(const void* model, void* data, const double* state, int signature);
using GetState = void (*)(const void* model, const void* data, double* state, int signature);
using Compute = void (*)(const void* model, void* data);  // mj_kinematics and its like
using Velocity = void (*)(const void* model, const void* data, int type, int body, double* result, int local);
constexpr int kTime = 1, kBody = 2;  // mjSTATE_TIME, mjOBJ_XBODY

constexpr double kFarthest = 1e4;                            // m; a world whose torso is farther away has diverged
constexpr double kStep = 0.02;                               // s
constexpr double kView = 60.0;                               // deg; limit of azimuth and elevation to all sides

// By default the library writes warnings to a file in the working directory. Here each world keeps its last one.
thread_local std::string* world_warning = nullptr;

void note_warning(const char* text) {
  if (world_warning != nullptr)
    *world_warning = text;
  else
    std::fprintf(stderr, "MuJoCo: %s\n", text);
}

void require(bool holds, const char* what) {
  if (!holds) throw nb::value_error(what);
}

template <class T>
T* pointer(std::uint64_t address) {
  return reinterpret_cast<T*>(static_cast<std::uintptr_t>(address));
}

// Bytes in a number of a snapshot, which holds whole numbers up to 2^53.
constexpr int kPacked = 6;

// Where things are in qpos, ctrl and sensordata. Sensors: torso quaternion, position, gyro, accelerometer, J angles, J speeds,
// force on the left foot, on the right foot; with a ball: whether each part touches it, its place in the camera's frame. Actuators
// of joint j: motor 3 j, position 3 j + 1, velocity 3 j + 2.
struct Layout {
  int joints, positions, torso, state, signature;
  int parts;     // whose contact with the ball is noted; 0 without a ball
  int rows = 0;  // of the kernel's solver that are remembered
  int sensors() const { return touching() + (parts ? parts + 3 : 0); }
  int foot_forces() const { return 13 + 2 * joints; }
  int touching() const { return 13 + 2 * joints + 6; }
  int packed() const { return (rows + kPacked - 1) / kPacked; }
  int row() const { return state + sensors() + parts + packed() + joints; }
};

struct World {
  void* data;
  double *ctrl, *sensordata, *qpos;
  double* joint_speeds;  // the joints' part of qvel
  double *xpos, *xmat;                   // of all bodies
};

// The models of robots that differ from each other. A model has up to 21 MB of meshes, and what differs is some kilobytes: each robot
// has its own numbers, and each thread a model into which it copies those of the robot that it steps.
class Models {
 public:
  explicit Models(std::uint64_t shared, std::size_t rows) : shared_(pointer<const void>(shared)), numbers_(rows) {}

  // `models`: one for each thread; `parts`: where in each of them the numbers are, model by model; `counts`: how many, part by part.
  void use(const Addresses& models, const Addresses& parts, const std::vector<int>& counts) {
    require(parts.size() == models.size() * counts.size(), "parts: one address for each model and part is needed");
    counts_ = counts;
    for (std::size_t k = 0; k < models.size(); ++k) {
      std::vector<double*> places;
      for (std::size_t p = 0; p < counts.size(); ++p) places.push_back(pointer<double>(parts.data()[k * counts.size() + p]));
      own_.push_back({pointer<const void>(models.data()[k]), places, -1});
    }
  }

  void set(int row, const Doubles& numbers) {
    std::size_t sum = 0;
    for (int count : counts_) sum += static_cast<std::size_t>(count);
    require(!own_.empty() && numbers.size() == sum, "numbers: wrong number");
    numbers_[row].assign(numbers.data(), numbers.data() + sum);
    std::lock_guard<std::mutex> lock(mutex_);  // others may be stepped in the background
    for (Own& own : own_)
      if (own.row == row) own.row = -1;
  }

 private:
  struct Own {
    const void* model;
    std::vector<double*> parts;
    int row;  // whose numbers it has; -1: nobody's
    bool taken = false;
  };

 public:
  // The model of a robot, for as long as this lives. A thread holds one at a time.
  class Held {
   public:
    Held(Models& models, int row) : models_(models), own_(models.take(row)) {}
    ~Held() {
      if (own_ == nullptr) return;
      std::lock_guard<std::mutex> lock(models_.mutex_);
      own_->taken = false;
    }
    Held(const Held&) = delete;
    Held& operator=(const Held&) = delete;
    operator const void*() const { return own_ != nullptr ? own_->model : models_.shared_; }

   private:
    Models& models_;
    Own* own_;
  };

 private:
  // A model that no thread holds, with the robot's numbers; nullptr if it has those of all.
  Own* take(int row) {
    const std::vector<double>& numbers = numbers_[row];
    if (numbers.empty()) return nullptr;
    Own* found = nullptr;
    {
      std::lock_guard<std::mutex> lock(mutex_);
      for (Own& own : own_)
        if (!own.taken && (found == nullptr || own.row == row)) found = &own;
      found->taken = true;  // there are as many as threads
      if (found->row == row) return found;
      found->row = row;
    }
    const double* from = numbers.data();
    for (std::size_t p = 0; p < counts_.size(); from += counts_[p++]) std::copy_n(from, counts_[p], found->parts[p]);
    return found;
  }

  const void* shared_;
  std::vector<std::vector<double>> numbers_;  // of each row; none: those of the shared model
  std::vector<int> counts_;
  std::vector<Own> own_;
  std::mutex mutex_;
};

class Worlds {
 public:
  Worlds(const nb::dict& functions, const nb::list& owners, std::uint64_t model, const Layout& layout, const Addresses& data, const Addresses& ctrl,
         const Addresses& sensordata, const Addresses& qpos, const Addresses& speeds,
         const Addresses& xpos, const Addresses& xmat, const Doubles& kp, const Doubles& kd, const std::vector<int>& bodies, int substeps,
         int delay, bool truncate, int threads)
      : owners_(owners),
        step_(pointer_to<Step>(functions["mj_step"])),
        set_state_(pointer_to<SetState>(functions["mj_setState"])),
        get_state_(pointer_to<GetState>(functions["mj_getState"])),
        kinematics_(pointer_to<Compute>(functions["mj_kinematics"])),
        centres_(pointer_to<Compute>(functions["mj_comPos"])),
        velocities_(pointer_to<Compute>(functions["mj_comVel"])),
        collision_(pointer_to<Compute>(functions["mj_collision"])),
        velocity_of_(pointer_to<Velocity>(functions["mj_objectVelocity"])),
        layout_(layout),
        substeps_(substeps),
        delay_(delay),
        truncate_(truncate),
        kp_(kp),
        kd_(kd),
        shared_model_(pointer<const void>(model)),
        models_(model, data.size()),
        bodies_(bodies),
        pool_(threads) {
    for (std::size_t k = 0; k < data.size(); ++k)
      worlds_.push_back({pointer<void>(data.data()[k]), pointer<double>(ctrl.data()[k]), pointer<double>(sensordata.data()[k]),
                         pointer<double>(qpos.data()[k]), pointer<double>(speeds.data()[k]),
                         pointer<double>(xpos.data()[k]), pointer<double>(xmat.data()[k])});
    const std::size_t n = worlds_.size(), joints = static_cast<std::size_t>(layout.joints);
    pending.assign(n * joints, 0.0);
    joint_angles.assign(n * joints, 0.0);
    joint_speeds.assign(n * joints, 0.0);
    torques.assign(n * joints, 0.0);
    torso_quat.assign(n * 4, 0.0);
    for (auto* triple : {&torso_pos, &gyro, &accel, &position}) triple->assign(n * 3, 0.0);
    rotation.assign(n * 9, 0.0);
    foot_frames.assign(n * 2 * static_cast<std::size_t>(substeps), 0.0);
    for (auto* triple : {&body_position, &body_velocity, &body_spin}) triple->assign(bodies_.size() * n * 3, 0.0);
    body_rotation.assign(bodies_.size() * n * 9, 0.0);
    contacts.assign(static_cast<std::size_t>(layout.parts) * n, 0.0);
    ball.assign(layout.parts ? 3 * n : 0, 0.0);
    diverged.assign(n, 0);
    warnings.resize(n);
    *pointer<void (*)(const char*)>(nb::cast<std::uint64_t>(functions["mju_user_warning"])) = note_warning;
    for (int row = 0; row < size(); ++row) {
      publish(row);
      publish_bodies(&row, 1);
    }
  }

  int size() const { return static_cast<int>(worlds_.size()); }
  int substeps() const { return substeps_; }
  const Layout& layout() const { return layout_; }
  const naosim::Threads* threads() const { return pool_.table(); }

  // Step the rows from `first` on with (count, J) target angles, except those that `active` leaves out and those that have diverged.
  // Without targets the worlds keep their commands.
  void step(const double* targets, int first, int count, const std::uint8_t* active) {
    const std::size_t joints = static_cast<std::size_t>(layout_.joints);
    if (kernel_ != nullptr) {
      const int size = chunk_size(count);
      pool_.run((count + size - 1) / size, [&](int k) { step_chunk(targets, first, count, active, k * size, size); });
      return;
    }
    pool_.run(count, [&](int k) {
      if (active == nullptr || active[k]) step_row(first + k, targets == nullptr ? nullptr : targets + k * joints);
    });
  }

  // The same in the background; finish() returns when all rows from `first` on are stepped.
  void begin(const double* targets, int first, int count) {
    const std::size_t joints = static_cast<std::size_t>(layout_.joints);
    Cycle& cycle = cycles_[first];
    if (cycle.running) throw std::logic_error("begin: the step before is not finished");
    cycle.running = true;
    cycle.targets.assign(targets, targets + count * joints);
    const int size = kernel_ != nullptr ? chunk_size(count) : 1;
    cycle.round.count = (count + size - 1) / size;
    cycle.round.job = [this, &cycle, first, count, joints, size](int k) {
      if (kernel_ != nullptr)
        step_chunk(cycle.targets.data(), first, count, nullptr, k * size, size);
      else
        step_row(first + k, &cycle.targets[k * joints]);
    };
    pool_.begin(cycle.round);
  }

  void finish(int first) {
    Cycle& cycle = cycles_[first];
    if (!cycle.running) throw std::logic_error("finish: no step has begun");
    pool_.finish(cycle.round);
    cycle.running = false;
  }

  // One row of a snapshot: integration state, sensordata, contacts with the ball, what the kernel remembers, pending command.
  void save(int row, double* out) const {
    const World& world = worlds_[row];
    get_state_(shared_model_, world.data, out, layout_.signature);
    out += layout_.state;
    std::memcpy(out, world.sensordata, sizeof(double) * layout_.sensors());
    out += layout_.sensors();
    for (int part = 0; part < layout_.parts; ++part) *out++ = contact(part, row);
    for (int first = 0; first < layout_.rows; first += kPacked) {
      double sum = 0.0;
      for (int k = std::min(first + kPacked, layout_.rows) - 1; k >= first; --k) sum = 256.0 * sum + remembered(row)[k];
      *out++ = sum;
    }
    std::memcpy(out, &pending[static_cast<std::size_t>(row) * layout_.joints], sizeof(double) * layout_.joints);
  }

  void load(int row, const double* from) {
    const World& world = worlds_[row];
    set_state_(shared_model_, world.data, from, layout_.signature);
    from += layout_.state;
    std::memcpy(world.sensordata, from, sizeof(double) * layout_.sensors());
    for (int s = 0; s < substeps_; ++s) note_contacts(row, s);
    from += layout_.sensors();
    for (int part = 0; part < layout_.parts; ++part) contact(part, row) = *from++;
    for (int first = 0; first < layout_.rows; first += kPacked) {
      std::uint64_t sum = *from >= 0.0 && *from < 0x1p48 ? static_cast<std::uint64_t>(*from) : 0;
      ++from;
      for (int k = first; k < std::min(first + kPacked, layout_.rows); ++k, sum >>= 8) remembered(row)[k] = static_cast<std::uint8_t>(sum);
    }
    std::memcpy(&pending[static_cast<std::size_t>(row) * layout_.joints], from, sizeof(double) * layout_.joints);
    warnings[row].clear();
    publish(row);
    publish_bodies(&row, 1);
  }

  // Publish what a changed state shows, the ball as if it were seen in this cycle.
  void refresh(int row) {
    publish(row);
    publish_bodies(&row, 1);
    if (layout_.parts) publish_ball(row);
  }

  // Forget which rows were active: the state is not the last substep's.
  void forget(int row) { std::fill_n(remembered(row), layout_.rows, std::uint8_t{0}); }

  // Robots that differ from each other: see Models::use; `owners`: the models.
  void use_models(const nb::list& owners, const Addresses& models, const Addresses& parts, const std::vector<int>& counts) {
    models_.use(models, parts, counts);
    for (nb::handle owner : owners) owners_.append(owner);
  }
  void set_own(int row, const Doubles& numbers) { models_.set(row, numbers); }

  // Step robots of one kind together, with the kernel's equations instead of mj_step; `isa` empty: the best that runs here. `warm`:
  // addresses of qacc_warmstart; `first_geom`: of the robot; `ball`: the ball's geom, -1 without one; `moving`: the kernel's numbers
  // of the bodies whose motion is published.
  void use_kernel(const std::string& robot, const std::string& isa, const Doubles& shared, const Addresses& warm, double step, int first_geom, int ball,
                  const std::vector<int>& moving) {
    const Kernel* kernel = naosim::humanoid::find_kernel(robot.c_str(), isa.empty() ? nullptr : isa.c_str());
    require(kernel != nullptr, "isa: expected generic, avx2 or avx512, which this processor must have");
    require(layout_.joints == kernel->topology.bodies - 1 && layout_.torso == (ball < 0 ? 0 : 7), "kernel: of another robot");
    require(shared.size() * sizeof(double) == kernel->shared && warm.size() == worlds_.size(), "kernel: wrong number of numbers");
    library_ = {collide, this, step, first_geom, ball};
    shared_.assign(shared.data(), shared.data() + shared.size());
    require(moving.size() == bodies_.size(), "moving: one number per body is needed");
    for (int body : moving) require(body >= 0 && body < kernel->topology.bodies + (ball >= 0), "moving: out of range");
    moving_ = moving;
    varied_.resize(worlds_.size() * kernel->varied / sizeof(double));
    layout_.rows = static_cast<int>(kernel->rows);
    remembered_.assign(worlds_.size() * kernel->rows, 0);
    robots_.resize(worlds_.size());
    for (std::size_t k = 0; k < worlds_.size(); ++k) {
      const World& world = worlds_[k];
      double *speeds = world.joint_speeds - 6, *accelerations = pointer<double>(warm.data()[k]), *none = nullptr;
      const bool with_ball = ball >= 0;
      robots_[k] = {&varied_[k * kernel->varied / sizeof(double)], 0, &remembered_[k * kernel->rows], world.qpos + layout_.torso, speeds, accelerations + (with_ball ? 6 : 0), world.sensordata,
                    world.ctrl, with_ball ? world.qpos : none, with_ball ? speeds - 6 : none, with_ball ? accelerations : none, world.data};
    }
    kernel_ = kernel;
  }

  void set_numbers(int row, const Doubles& varied) {
    static std::atomic<std::uint64_t> latest{0};
    require(kernel_ != nullptr && varied.size() * sizeof(double) == kernel_->varied, "numbers: wrong number");
    std::memcpy(&varied_[static_cast<std::size_t>(row) * varied.size()], varied.data(), kernel_->varied);
    // the same numbers as its neighbour's need not be read again for another robot
    const bool same = row > 0 && std::memcmp(robots_[row].numbers, robots_[row - 1].numbers, kernel_->varied) == 0;
    robots_[row].version = same ? robots_[row - 1].version : ++latest;
  }

  const char* kernel() const { return kernel_ != nullptr ? kernel_->name : ""; }
  std::uint64_t left_to_mujoco() const { return left_to_mujoco_; }
  std::uint64_t collided_by_mujoco() const { return collided_; }

  // Nothing but mj_step, for benchmarks.
  void step_bare(int cycles) {
    for (int cycle = 0; cycle < cycles; ++cycle)
      for (int row = 0; row < size(); ++row) {
        const Models::Held model(models_, row);
        for (int s = 0; s < substeps_; ++s) step_(model, worlds_[row].data);
      }
  }

  std::vector<double> pending, joint_angles, joint_speeds, torques, torso_quat, torso_pos, gyro, accel, position, rotation, foot_frames;
  std::vector<double> body_position, body_rotation, body_velocity, body_spin;  // body by body, then row by row
  std::vector<double> contacts, ball;                                          // part by part; row by row
  std::vector<std::uint8_t> diverged;
  std::vector<std::string> warnings;

 private:
  struct Cycle {
    naosim::Round round;
    std::vector<double> targets;
    bool running = false;
  };

  // Rows that a thread steps together: they regroup before each substep, alike ones in one group.
  static constexpr int kMostInChunk = 64;
  int chunk_size(int count) const {
    const int lanes = kernel_->lanes, share = (count + pool_.size() - 1) / pool_.size();
    return std::min(kMostInChunk, (share + lanes - 1) / lanes * lanes);
  }

  void step_chunk(const double* targets, int first, int count, const std::uint8_t* active, int begin, int most) {
    const std::size_t joints = static_cast<std::size_t>(layout_.joints);
    naosim::humanoid::Robot* robots[kMostInChunk];
    int size = 0;
    for (int k = begin; k < std::min(count, begin + most); ++k) {
      const int row = first + k;
      if ((active != nullptr && !active[k]) || diverged[row]) continue;
      command(row, targets == nullptr ? nullptr : targets + k * joints);
      robots[size++] = &robots_[row];
    }
    for (int s = 0; s < substeps_; ++s) {
      std::stable_sort(robots, robots + size, [](const auto* a, const auto* b) { return a->key < b->key; });
      for (int k = 0; k < size; k += kernel_->lanes) kernel_->substep(shared_.data(), library_, robots + k, std::min(kernel_->lanes, size - k), s == substeps_ - 1);
      for (int k = 0; k < size; ++k) {
        const int row = static_cast<int>(robots[k] - robots_.data());
        collided_ += robots[k]->collided;
        if (!robots[k]->settled) {
          world_warning = &warnings[row];
          step_(Models::Held(models_, row), worlds_[row].data);
          world_warning = nullptr;
          ++left_to_mujoco_;
        } else if (layout_.parts) {
          double time;
          get_state_(shared_model_, worlds_[row].data, &time, kTime);
          time += library_.step;
          set_state_(shared_model_, worlds_[row].data, &time, kTime);
        }
        note_contacts(row, s);
      }
    }
    int rows[kMostInChunk];
    for (int k = 0; k < size; ++k) {
      rows[k] = static_cast<int>(robots[k] - robots_.data());
      publish(rows[k]);
    }
    publish_bodies(rows, size);
  }

  // Set the motors' targets, as late as the server does.
  void command(int row, const double* targets) {
    const std::size_t joints = static_cast<std::size_t>(layout_.joints);
    double* waiting = &pending[row * joints];
    for (std::size_t j = 0; j < joints && targets != nullptr; ++j) {
      const double target = command_degrees(targets[j]) * kRadians;
      worlds_[row].ctrl[3 * j + 1] = delay_ ? waiting[j] : target;
      waiting[j] = target;
    }
  }

  void step_row(int row, const double* targets) {
    if (diverged[row]) return;
    const World& world = worlds_[row];
    command(row, targets);
    world_warning = &warnings[row];
    {
      const Models::Held model(models_, row);
      for (int s = 0; s < substeps_; ++s) {
        step_(model, world.data);
        note_contacts(row, s);
      }
    }
    world_warning = nullptr;
    publish(row);
    publish_bodies(&row, 1);
  }

  static void collide(void* worlds, const naosim::humanoid::Robot& robot) {
    Worlds& self = *static_cast<Worlds*>(worlds);
    const Models::Held model(self.models_, static_cast<int>(&robot - self.robots_.data()));
    for (Compute compute : {self.kinematics_, self.collision_}) compute(model, robot.data);
  }

  std::uint8_t* remembered(int row) { return remembered_.data() + static_cast<std::size_t>(row) * layout_.rows; }
  const std::uint8_t* remembered(int row) const { return remembered_.data() + static_cast<std::size_t>(row) * layout_.rows; }

  double& contact(int part, int row) { return contacts[static_cast<std::size_t>(part) * worlds_.size() + row]; }
  double contact(int part, int row) const { return contacts[static_cast<std::size_t>(part) * worlds_.size() + row]; }

  template <class T>
  static T pointer_to(nb::handle address) {
    return reinterpret_cast<T>(static_cast<std::uintptr_t>(nb::cast<std::uint64_t>(address)));
  }

  void note_contacts(int row, int substep) {
    const double* forces = worlds_[row].sensordata + layout_.foot_forces();
    double* frame = &foot_frames[(static_cast<std::size_t>(row) * substeps_ + substep) * 2];
    frame[0] = forces[2];
    frame[1] = forces[5];
    const double* touching = worlds_[row].sensordata + layout_.touching();
    for (int part = 0; part < layout_.parts; ++part) {
      double& share = contact(part, row);
      share = (substep ? share : 0.0) + (touching[part] > 0.0 ? 1.0 / substeps_ : 0.0);
    }
  }

  // The server prints torso pose with three decimals and everything else with two, truncated toward zero.
  void print(const double* from, int count, double unit, double decimals, double* out) const {
    for (int k = 0; k < count; ++k) {
      const double value = from[k] * unit;
      out[k] = truncate_ ? std::trunc(value * decimals) / decimals : value;
    }
  }

  void publish(int row) {
    const std::size_t r = static_cast<std::size_t>(row), joints = static_cast<std::size_t>(layout_.joints);
    const double* s = worlds_[row].sensordata;
    print(s, 4, 1.0, 1000.0, &torso_quat[4 * r]);
    print(s + 4, 3, 1.0, 1000.0, &torso_pos[3 * r]);
    print(s + 7, 3, kDegrees, 100.0, &gyro[3 * r]);
    print(s + 10, 3, 1.0, 100.0, &accel[3 * r]);
    print(s + 13, layout_.joints, kDegrees, 100.0, &joint_angles[joints * r]);
    print(s + 13 + joints, layout_.joints, kDegrees, 100.0, &joint_speeds[joints * r]);
    const double *kp = kp_.data() + joints * r, *kd = kd_.data() + joints * r, *angles = s + 13, *speeds = angles + joints;
    for (std::size_t j = 0; j < joints; ++j) torques[joints * r + j] = kp[j] * (worlds_[row].ctrl[3 * j + 1] - angles[j]) - kd[j] * speeds[j];
    const double* x = worlds_[row].qpos + layout_.torso;
    std::memcpy(&position[3 * r], x, 3 * sizeof(double));
    rotation_of(x + 3, &rotation[9 * r]);
    double sum = 0.0;
    for (int k = 0; k < layout_.positions; ++k) sum += worlds_[row].qpos[k];
    diverged[r] = !std::isfinite(sum) || std::fabs(x[0]) + std::fabs(x[1]) + std::fabs(x[2]) > kFarthest;
    if (layout_.parts) {
      double time;
      get_state_(shared_model_, worlds_[row].data, &time, kTime);
      if (std::lround(time / kStep) % 2 == 0)  // the server reports what is seen in every other cycle
        publish_ball(row);
      else
        for (int k = 0; k < 3; ++k) ball[3 * r + k] = std::nan("");
    }
  }

  // Motion of the named bodies at the end of the step.
  void publish_bodies(const int* rows, int count) {
    const auto put = [&](std::size_t body, int row, const double* place, const double* turn, const double* velocity, const double* spin) {
      const std::size_t at = body * worlds_.size() + static_cast<std::size_t>(row);
      std::memcpy(&body_position[3 * at], place, 3 * sizeof(double));
      std::memcpy(&body_rotation[9 * at], turn, 9 * sizeof(double));
      std::memcpy(&body_velocity[3 * at], velocity, 3 * sizeof(double));
      std::memcpy(&body_spin[3 * at], spin, 3 * sizeof(double));
    };
    const std::size_t bodies = bodies_.size();
    if (bodies == 0) return;
    if (kernel_ != nullptr) {
      constexpr std::size_t width = naosim::humanoid::kMotion;
      std::vector<double> found(static_cast<std::size_t>(kernel_->lanes) * bodies * width);
      for (int k = 0; k < count; k += kernel_->lanes) {
        naosim::humanoid::Robot* robots[8];
        const int size = std::min(kernel_->lanes, count - k);
        for (int l = 0; l < size; ++l) robots[l] = &robots_[rows[k + l]];
        kernel_->motion(shared_.data(), robots, size, moving_.data(), static_cast<int>(bodies), found.data());
        for (int l = 0; l < size; ++l)
          for (std::size_t b = 0; b < bodies; ++b) {
            const double* of = &found[(static_cast<std::size_t>(l) * bodies + b) * width];
            put(b, rows[k + l], of, of + 3, of + 12, of + 15);
          }
      }
      return;
    }
    for (int k = 0; k < count; ++k) {  // what mj_step has left in the data is 5 ms older; the next step computes it again
      const World& world = worlds_[rows[k]];
      const Models::Held model(models_, rows[k]);
      for (Compute compute : {kinematics_, centres_, velocities_}) compute(model, world.data);
      for (std::size_t b = 0; b < bodies; ++b) {
        double motion[6];
        velocity_of_(model, world.data, kBody, bodies_[b], motion, 0);
        put(b, rows[k], world.xpos + 3 * bodies_[b], world.xmat + 9 * bodies_[b], motion + 3, motion);
      }
    }
  }

  // The ball as the server reports it: distance, azimuth and elevation from the camera; NaN out of view.
  void publish_ball(int row) {
    const double* p = worlds_[row].sensordata + layout_.touching() + layout_.parts;
    const double distance = std::sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]);
    const double polar[3] = {distance, std::atan2(p[1], p[0]) * kDegrees, std::asin(p[2] / distance) * kDegrees};
    double* out = &ball[3 * static_cast<std::size_t>(row)];
    print(polar, 3, 1.0, 100.0, out);
    if (!(std::fabs(out[1]) <= kView && std::fabs(out[2]) <= kView)) out[0] = out[1] = out[2] = std::nan("");
  }

  nb::list owners_;  // first, so that helpers have ended when it goes: the objects whose memory they use
  Step step_;
  SetState set_state_;
  GetState get_state_;
  Compute kinematics_, centres_, velocities_, collision_;
  Velocity velocity_of_;
  Layout layout_;
  int substeps_, delay_;
  bool truncate_;
  Doubles kp_, kd_;  // of every world's motors, which Python changes
  const void* shared_model_;
  Models models_;
  std::vector<World> worlds_;
  const Kernel* kernel_ = nullptr;  // null: mj_step
  naosim::humanoid::Library library_;
  std::vector<double> shared_, varied_;  // Shared, and row by row Varied, of humanoid_model.hpp
  std::vector<naosim::humanoid::Robot> robots_;
  std::vector<std::uint8_t> remembered_;  // row by row, Kernel::rows
  std::vector<int> moving_;               // the kernel's numbers of bodies_
  std::atomic<std::uint64_t> left_to_mujoco_{0}, collided_{0};  // substeps
  std::vector<int> bodies_;  // whose motion is published
  std::map<int, Cycle> cycles_;  // in the background, by their first row
  naosim::ThreadPool pool_;      // last: its helpers use the rest
};

int row_of(const Worlds& worlds, int row) {
  require(row >= 0 && row < worlds.size(), "row: out of range");
  return row;
}

}  // namespace

NB_MODULE(_mujoco, m) {
  m.def("topology", [](const std::string& robot) {
    const Kernel* kernel = naosim::humanoid::find_kernel(robot.c_str(), nullptr);
    require(kernel != nullptr, "robot: no kernel is compiled for it");
    const auto& t = kernel->topology;
    const auto list = [](const int* values, int count) { return std::vector<int>(values, values + count); };
    nb::dict out;
    out["parents"] = list(t.parents, t.bodies), out["axes"] = list(t.axes, t.bodies);
    out["geom_bodies"] = list(t.geom_bodies, t.geoms), out["geom_shapes"] = list(t.geom_shapes, t.geoms);
    return out;
  });
  nb::class_<Worlds>(m, "Worlds")
      .def("__init__",
           [](Worlds* self, const nb::dict& functions, const nb::list& owners, std::uint64_t model, int joints, int positions, int torso, int state, int signature, int parts,
              const Addresses& data, const Addresses& ctrl, const Addresses& sensordata, const Addresses& qpos,
              const Addresses& speeds, const Addresses& xpos, const Addresses& xmat, const Doubles& kp, const Doubles& kd,
              const std::vector<int>& bodies, int substeps, int delay, bool truncate, int threads) {
             require(data.size() >= 1, "one world at least");
             for (const Addresses* each : {&ctrl, &sensordata, &qpos, &speeds, &xpos, &xmat})
               require(each->size() == data.size(), "one address per world is needed");
             require(kp.size() == data.size() * static_cast<std::size_t>(joints) && kd.size() == kp.size(), "kp, kd: wrong shape");
             require(joints >= 1 && positions >= torso + 7 && torso >= 0 && state >= 1 && parts >= 0, "layout: out of range");
             require(substeps >= 1 && (delay == 0 || delay == 1) && threads >= 1, "substeps, delay, threads: out of range");
             new (self) Worlds(functions, owners, model, {joints, positions, torso, state, signature, parts}, data, ctrl, sensordata, qpos, speeds,
                               xpos, xmat, kp, kd, bodies, substeps, delay, truncate, threads);
           }, nb::kw_only(), nb::arg("functions"), nb::arg("owners"), nb::arg("model"), nb::arg("joints"), nb::arg("positions"), nb::arg("torso"),
           nb::arg("state"), nb::arg("signature"), nb::arg("parts"), nb::arg("data"), nb::arg("ctrl"), nb::arg("sensordata"), nb::arg("qpos"),
           nb::arg("speeds"), nb::arg("xpos"), nb::arg("xmat"), nb::arg("kp"), nb::arg("kd"), nb::arg("bodies"),
           nb::arg("substeps"), nb::arg("delay"), nb::arg("truncate"), nb::arg("threads"))
      .def("step",
           [](Worlds& self, const Doubles& targets, int first, const std::optional<Bytes>& active) {
             const std::size_t joints = static_cast<std::size_t>(self.layout().joints), count = targets.size() / joints;
             require(targets.size() == count * joints, "targets: wrong shape");
             require(first >= 0 && first + static_cast<int>(count) <= self.size(), "rows: out of range");
             require(!active || active->size() == count, "active: one value per row is needed");
             const std::uint8_t* mask = active ? active->data() : nullptr;
             const double* data = targets.data();
             nb::gil_scoped_release release;
             self.step(data, first, static_cast<int>(count), mask);
           }, nb::arg("targets"), nb::arg("first"), nb::arg("active").none())
      .def("begin",
           [](Worlds& self, const Doubles& targets, int first) {
             const std::size_t joints = static_cast<std::size_t>(self.layout().joints), count = targets.size() / joints;
             require(targets.size() == count * joints, "targets: wrong shape");
             require(first >= 0 && first + static_cast<int>(count) <= self.size(), "rows: out of range");
             require(std::all_of(targets.data(), targets.data() + targets.size(), [](double target) { return std::isfinite(target); }),
                     "targets_rad: expected finite numbers");
             self.begin(targets.data(), first, static_cast<int>(count));
           }, nb::arg("targets"), nb::arg("first"))
      .def("finish",
           [](Worlds& self, int first) {
             nb::gil_scoped_release release;
             self.finish(first);
           }, nb::arg("first"))
      .def("step_unchanged",
           [](Worlds& self) {
             nb::gil_scoped_release release;
             self.step(nullptr, 0, self.size(), nullptr);
           })
      .def("step_bare",
           [](Worlds& self, int cycles) {
             nb::gil_scoped_release release;
             self.step_bare(cycles);
           })
      .def("save",
           [](const Worlds& self, int row, Output out) {
             require(out.size() == static_cast<std::size_t>(self.layout().row()), "out: wrong shape");
             self.save(row_of(self, row), out.data());
           })
      .def("load",
           [](Worlds& self, int row, const Doubles& from) {
             require(from.size() == static_cast<std::size_t>(self.layout().row()), "state: wrong shape");
             self.load(row_of(self, row), from.data());
           })
      .def("refresh", [](Worlds& self, int row) { self.refresh(row_of(self, row)); })
      .def("forget", [](Worlds& self, int row) { self.forget(row_of(self, row)); })
      .def("use_models", &Worlds::use_models, nb::arg("owners"), nb::arg("models"), nb::arg("parts"), nb::arg("counts"))
      .def("set_own", [](Worlds& self, int row, const Doubles& numbers) { self.set_own(row_of(self, row), numbers); })
      .def("use_kernel", &Worlds::use_kernel, nb::arg("robot"), nb::arg("isa"), nb::arg("shared"), nb::arg("warm"), nb::arg("step"),
           nb::arg("first_geom"), nb::arg("ball"), nb::arg("moving"))
      .def("set_numbers", [](Worlds& self, int row, const Doubles& varied) { self.set_numbers(row_of(self, row), varied); })
      .def_prop_ro("kernel", &Worlds::kernel)
      .def_prop_ro("left_to_mujoco", &Worlds::left_to_mujoco)
      .def_prop_ro("collided_by_mujoco", &Worlds::collided_by_mujoco)
      .def("warning", [](const Worlds& self, int row) { return self.warnings[row_of(self, row)]; })
      .def_prop_ro("threads", [](const Worlds& self) { return reinterpret_cast<std::uintptr_t>(self.threads()); })
      .def_prop_ro("row_size", [](const Worlds& self) { return self.layout().row(); })
      .def("views", [](nb::handle self) {
        Worlds& w = nb::cast<Worlds&>(self);
        const std::size_t n = static_cast<std::size_t>(w.size()), joints = static_cast<std::size_t>(w.layout().joints);
        const auto view = [&](std::vector<double>& data, std::initializer_list<std::size_t> shape) {
          return nb::ndarray<nb::numpy, double>(data.data(), shape, self);
        };
        nb::dict views;
        views["joint_angles"] = view(w.joint_angles, {n, joints});
        views["joint_speeds"] = view(w.joint_speeds, {n, joints});
        views["torques"] = view(w.torques, {n, joints});
        views["torso_quat"] = view(w.torso_quat, {n, 4});
        views["torso_pos"] = view(w.torso_pos, {n, 3});
        views["gyro"] = view(w.gyro, {n, 3});
        views["accel"] = view(w.accel, {n, 3});
        views["position"] = view(w.position, {n, 3});
        views["rotation"] = view(w.rotation, {n, 3, 3});
        views["foot_frames"] = view(w.foot_frames, {n, static_cast<std::size_t>(w.substeps()), 2});
        const std::size_t bodies = n ? w.body_position.size() / (3 * n) : 0, parts = static_cast<std::size_t>(w.layout().parts);
        views["body_position"] = view(w.body_position, {bodies, n, 3});
        views["body_rotation"] = view(w.body_rotation, {bodies, n, 3, 3});
        views["body_velocity"] = view(w.body_velocity, {bodies, n, 3});
        views["body_spin"] = view(w.body_spin, {bodies, n, 3});
        views["contacts"] = view(w.contacts, {parts, n});
        views["ball"] = view(w.ball, {parts ? n : 0, 3});
        views["diverged"] = nb::ndarray<nb::numpy, std::uint8_t>(w.diverged.data(), {n}, self);
        return views;
      });

  auto exchange = nb::class_<MujocoExchange>(m, "Exchange");
  exchange
      .def("__init__",
           [](MujocoExchange* self, int n, const std::vector<std::string>& perceptors, const std::vector<std::string>& effectors,
              const std::vector<double>& kp, const std::vector<double>& kd, bool ball) {
             const std::size_t joints = perceptors.size();
             require(n >= 1 && joints >= 1, "one server and one joint at least");
             require(effectors.size() == joints && kp.size() == joints && kd.size() == joints, "one effector, kp and kd per joint are needed");
             new (self) MujocoExchange(n, perceptors, effectors, kp, kd, ball);
           }, nb::arg("n"), nb::arg("perceptors"), nb::arg("effectors"), nb::arg("kp"), nb::arg("kd"), nb::arg("ball"))
      .def("prepend",
           [](MujocoExchange& self, int row, const std::string& text) { self.prepend(naosim::protocol::row_of(self, row), text); })
      .def("messages", [](const MujocoExchange& self, int row) { return self.messages_of(naosim::protocol::row_of(self, row)); })
      .def("play_mode", [](const MujocoExchange& self, int row) { return self.play_mode(naosim::protocol::row_of(self, row)); })
      .def("views", [](nb::handle self) {
        MujocoExchange& e = nb::cast<MujocoExchange&>(self);
        const std::size_t n = static_cast<std::size_t>(e.size()), joints = e.joint_count();
        const auto view = [&](std::vector<double>& data, std::initializer_list<std::size_t> shape) {
          return nb::ndarray<nb::numpy, double>(data.data(), shape, self);
        };
        nb::dict views;
        views["joint_angles"] = view(e.joint_angles, {n, joints});
        views["joint_speeds"] = view(e.joint_speeds, {n, joints});
        views["torso_quat"] = view(e.torso_quat, {n, 4});
        views["torso_pos"] = view(e.torso_pos, {n, 3});
        views["gyro"] = view(e.gyro, {n, 3});
        views["accel"] = view(e.accel, {n, 3});
        views["ball"] = view(e.ball, {n, 3});
        views["time"] = view(e.time, {n});
        views["rotation"] = view(e.rotation, {n, 3, 3});
        return views;
      });
  naosim::protocol::bind_exchange(exchange);
}
