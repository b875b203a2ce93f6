// Many MuJoCo worlds of one model, stepped together; naosim.mujoco.batch documents the arguments.
//
// The library is the one that the Python package has loaded: the addresses of its functions and of the worlds' arrays are handed
// over, so that neither headers nor a library are needed to build this file.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <cstdio>
#include <cstring>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

#include "exchange_bindings.hpp"
#include "mujoco_exchange.hpp"
#include "mujoco_units.hpp"
#include "thread_pool.hpp"

namespace nb = nanobind;

using Doubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Bytes = nb::ndarray<const std::uint8_t, nb::c_contig, nb::device::cpu>;
using Addresses = nb::ndarray<const std::uint64_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Output = nb::ndarray<double, nb::c_contig, nb::device::cpu>;

using naosim::mujoco::command_degrees, naosim::mujoco::kDegrees, naosim::mujoco::kRadians, naosim::mujoco::rotation_of;
using naosim::protocol::MujocoExchange;

namespace {

// mujoco.h of 3.5.0
using Step = void (*)(const void* model, void* data);
using SetState = void (*)(const void* model, void* data, const double* state, int signature);
using GetState = void (*)(const void* model, const void* data, double* state, int signature);

constexpr double kFarthest = 1e4;                            // m; a world whose torso is farther away has diverged
constexpr double kSliding = 0.1;                             // rad/s; joint friction is proportional to slower speeds

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

// Where things are in qpos, ctrl and sensordata. Sensors: torso quaternion, position, gyro, accelerometer, J angles, J speeds,
// force on the left foot, on the right foot. Actuators of joint j: motor 3 j, position 3 j + 1, velocity 3 j + 2.
struct Layout {
  int joints, positions, torso, state, signature;
  int sensors() const { return 13 + 2 * joints + 6; }
  int foot_forces() const { return 13 + 2 * joints; }
  int row() const { return state + sensors() + joints; }
};

struct World {
  const void* model;
  void* data;
  double *ctrl, *sensordata, *qpos;
  double *joint_speeds, *joint_torques;  // the joints' part of qvel and qfrc_applied
};

class Worlds {
 public:
  Worlds(const nb::dict& functions, std::uint64_t model, const Layout& layout, const Addresses& data, const Addresses& ctrl,
         const Addresses& sensordata, const Addresses& qpos, const Addresses& speeds, const Addresses& torques,
         const Doubles& friction, int substeps, int delay, bool truncate, int threads)
      : step_(pointer_to<Step>(functions["mj_step"])),
        set_state_(pointer_to<SetState>(functions["mj_setState"])),
        get_state_(pointer_to<GetState>(functions["mj_getState"])),
        layout_(layout),
        substeps_(substeps),
        delay_(delay),
        truncate_(truncate),
        pool_(threads) {
    for (std::size_t k = 0; k < data.size(); ++k)
      worlds_.push_back({pointer<const void>(model), pointer<void>(data.data()[k]), pointer<double>(ctrl.data()[k]), pointer<double>(sensordata.data()[k]),
                         pointer<double>(qpos.data()[k]), pointer<double>(speeds.data()[k]), pointer<double>(torques.data()[k])});
    friction_.assign(friction.data(), friction.data() + friction.size());
    const std::size_t n = worlds_.size(), joints = static_cast<std::size_t>(layout.joints);
    pending.assign(n * joints, 0.0);
    joint_angles.assign(n * joints, 0.0);
    joint_speeds.assign(n * joints, 0.0);
    torso_quat.assign(n * 4, 0.0);
    for (auto* triple : {&torso_pos, &gyro, &accel, &position}) triple->assign(n * 3, 0.0);
    rotation.assign(n * 9, 0.0);
    foot_frames.assign(n * 2 * static_cast<std::size_t>(substeps), 0.0);
    diverged.assign(n, 0);
    warnings.resize(n);
    *pointer<void (*)(const char*)>(nb::cast<std::uint64_t>(functions["mju_user_warning"])) = note_warning;
    for (int row = 0; row < size(); ++row) publish(row);
  }

  int size() const { return static_cast<int>(worlds_.size()); }
  int substeps() const { return substeps_; }
  const Layout& layout() const { return layout_; }
  const naosim::Threads* threads() const { return pool_.table(); }

  // Step the rows from `first` on with (count, J) target angles, except those that `active` leaves out and those that have diverged.
  // Without targets the worlds keep their commands.
  void step(const double* targets, int first, int count, const std::uint8_t* active) {
    const std::size_t joints = static_cast<std::size_t>(layout_.joints);
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
    cycle.round.count = count;
    cycle.round.job = [this, &cycle, first, joints](int k) { step_row(first + k, &cycle.targets[k * joints]); };
    pool_.begin(cycle.round);
  }

  void finish(int first) {
    Cycle& cycle = cycles_[first];
    if (!cycle.running) throw std::logic_error("finish: no step has begun");
    pool_.finish(cycle.round);
    cycle.running = false;
  }

  // One row of a snapshot: integration state, sensordata, pending command.
  void save(int row, double* out) const {
    const World& world = worlds_[row];
    get_state_(world.model, world.data, out, layout_.signature);
    out += layout_.state;
    std::memcpy(out, world.sensordata, sizeof(double) * layout_.sensors());
    std::memcpy(out + layout_.sensors(), &pending[static_cast<std::size_t>(row) * layout_.joints], sizeof(double) * layout_.joints);
  }

  void load(int row, const double* from) {
    const World& world = worlds_[row];
    set_state_(world.model, world.data, from, layout_.signature);
    from += layout_.state;
    std::memcpy(world.sensordata, from, sizeof(double) * layout_.sensors());
    std::memcpy(&pending[static_cast<std::size_t>(row) * layout_.joints], from + layout_.sensors(), sizeof(double) * layout_.joints);
    for (int s = 0; s < substeps_; ++s) note_feet(row, s);
    warnings[row].clear();
    publish(row);
  }

  void set_model(int row, std::uint64_t model) { worlds_[row].model = pointer<const void>(model); }

  // Nothing but mj_step and the joints' friction, for benchmarks.
  void step_bare(int cycles) {
    for (int cycle = 0; cycle < cycles; ++cycle)
      for (const World& world : worlds_)
        for (int s = 0; s < substeps_; ++s) {
          apply_friction(world);
          step_(world.model, world.data);
        }
  }

  std::vector<double> pending, joint_angles, joint_speeds, torso_quat, torso_pos, gyro, accel, position, rotation, foot_frames;
  std::vector<std::uint8_t> diverged;
  std::vector<std::string> warnings;

 private:
  struct Cycle {
    naosim::Round round;
    std::vector<double> targets;
    bool running = false;
  };

  void step_row(int row, const double* targets) {
    if (diverged[row]) return;
    const std::size_t joints = static_cast<std::size_t>(layout_.joints);
    const World& world = worlds_[row];
    double* waiting = &pending[row * joints];
    for (std::size_t j = 0; j < joints && targets != nullptr; ++j) {
      const double target = command_degrees(targets[j]) * kRadians;
      world.ctrl[3 * j + 1] = delay_ ? waiting[j] : target;
      waiting[j] = target;
    }
    world_warning = &warnings[row];
    for (int s = 0; s < substeps_; ++s) {
      apply_friction(world);
      step_(world.model, world.data);
      note_feet(row, s);
    }
    world_warning = nullptr;
    publish(row);
  }

  template <class T>
  static T pointer_to(nb::handle address) {
    return reinterpret_cast<T>(static_cast<std::uintptr_t>(nb::cast<std::uint64_t>(address)));
  }

  // Coulomb friction of the joints as torques, where the model has none.
  void apply_friction(const World& world) const {
    for (std::size_t j = 0; j < friction_.size(); ++j)
      world.joint_torques[j] = -friction_[j] * std::fmax(-1.0, std::fmin(1.0, world.joint_speeds[j] / kSliding));
  }

  void note_feet(int row, int substep) {
    const double* forces = worlds_[row].sensordata + layout_.foot_forces();
    double* frame = &foot_frames[(static_cast<std::size_t>(row) * substeps_ + substep) * 2];
    frame[0] = forces[2];
    frame[1] = forces[5];
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
    const double* x = worlds_[row].qpos + layout_.torso;
    std::memcpy(&position[3 * r], x, 3 * sizeof(double));
    rotation_of(x + 3, &rotation[9 * r]);
    double sum = 0.0;
    for (int k = 0; k < layout_.positions; ++k) sum += worlds_[row].qpos[k];
    diverged[r] = !std::isfinite(sum) || std::fabs(x[0]) + std::fabs(x[1]) + std::fabs(x[2]) > kFarthest;
  }

  Step step_;
  SetState set_state_;
  GetState get_state_;
  Layout layout_;
  int substeps_, delay_;
  bool truncate_;
  std::vector<World> worlds_;
  std::vector<double> friction_;
  std::map<int, Cycle> cycles_;  // in the background, by their first row
  naosim::ThreadPool pool_;      // last: its helpers use the rest
};

int row_of(const Worlds& worlds, int row) {
  require(row >= 0 && row < worlds.size(), "row: out of range");
  return row;
}

}  // namespace

NB_MODULE(_mujoco, m) {
  nb::class_<Worlds>(m, "Worlds")
      .def("__init__",
           [](Worlds* self, const nb::dict& functions, std::uint64_t model, int joints, int positions, int torso, int state, int signature,
              const Addresses& data, const Addresses& ctrl, const Addresses& sensordata, const Addresses& qpos,
              const Addresses& speeds, const Addresses& torques, const Doubles& friction, int substeps, int delay, bool truncate,
              int threads) {
             require(data.size() >= 1, "one world at least");
             for (const Addresses* each : {&ctrl, &sensordata, &qpos, &speeds, &torques})
               require(each->size() == data.size(), "one address per world is needed");
             require(friction.size() == 0 || friction.size() == static_cast<std::size_t>(joints), "friction: one value per joint, or none");
             require(joints >= 1 && positions >= torso + 7 && torso >= 0 && state >= 1, "layout: out of range");
             require(substeps >= 1 && (delay == 0 || delay == 1) && threads >= 1, "substeps, delay, threads: out of range");
             new (self) Worlds(functions, model, {joints, positions, torso, state, signature}, data, ctrl, sensordata, qpos, speeds,
                               torques, friction, substeps, delay, truncate, threads);
           }, nb::kw_only(), nb::arg("functions"), nb::arg("model"), nb::arg("joints"), nb::arg("positions"), nb::arg("torso"),
           nb::arg("state"), nb::arg("signature"), nb::arg("data"), nb::arg("ctrl"), nb::arg("sensordata"), nb::arg("qpos"),
           nb::arg("speeds"), nb::arg("torques"), nb::arg("friction"), nb::arg("substeps"), nb::arg("delay"), nb::arg("truncate"), nb::arg("threads"))
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
      .def("set_model", [](Worlds& self, int row, std::uint64_t model) { self.set_model(row_of(self, row), model); })
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
        views["torso_quat"] = view(w.torso_quat, {n, 4});
        views["torso_pos"] = view(w.torso_pos, {n, 3});
        views["gyro"] = view(w.gyro, {n, 3});
        views["accel"] = view(w.accel, {n, 3});
        views["position"] = view(w.position, {n, 3});
        views["rotation"] = view(w.rotation, {n, 3, 3});
        views["foot_frames"] = view(w.foot_frames, {n, static_cast<std::size_t>(w.substeps()), 2});
        views["diverged"] = nb::ndarray<nb::numpy, std::uint8_t>(w.diverged.data(), {n}, self);
        return views;
      });

  auto exchange = nb::class_<MujocoExchange>(m, "Exchange");
  exchange
      .def("__init__",
           [](MujocoExchange* self, int n, const std::vector<std::string>& perceptors, const std::vector<std::string>& effectors,
              const std::vector<double>& kp, const std::vector<double>& kd) {
             const std::size_t joints = perceptors.size();
             require(n >= 1 && joints >= 1, "one server and one joint at least");
             require(effectors.size() == joints && kp.size() == joints && kd.size() == joints, "one effector, kp and kd per joint are needed");
             new (self) MujocoExchange(n, perceptors, effectors, kp, kd);
           }, nb::arg("n"), nb::arg("perceptors"), nb::arg("effectors"), nb::arg("kp"), nb::arg("kd"))
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
        views["time"] = view(e.time, {n});
        views["rotation"] = view(e.rotation, {n, 3, 3});
        return views;
      });
  naosim::protocol::bind_exchange(exchange);
}
