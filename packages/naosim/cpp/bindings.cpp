// Python bindings; naosim.simspark.batch checks and documents the arguments.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <cstring>

#include "batch.hpp"

namespace nb = nanobind;
using namespace naosim;

using Doubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Bytes = nb::ndarray<const std::uint8_t, nb::c_contig, nb::device::cpu>;
using Index = nb::ndarray<const std::int64_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Output = nb::ndarray<double, nb::c_contig, nb::device::cpu>;
using ByteOutput = nb::ndarray<std::uint8_t, nb::c_contig, nb::device::cpu>;

namespace {

void require(bool holds, const char* what) {
  if (!holds) throw nb::value_error(what);
}

Model make_model(const nb::dict& table) {
  const auto numbers = [&](const char* key) { return nb::cast<Doubles>(table[key]); };
  const Doubles mass = numbers("mass"), inertia = numbers("inertia"), parent = numbers("parent"), shape = numbers("shape"),
                half = numbers("half"), radius = numbers("radius"), half_length = numbers("half_length"), offset = numbers("offset"),
                anchor = numbers("anchor"), parent_anchor = numbers("parent_anchor"), axis = numbers("axis"), low = numbers("low"),
                high = numbers("high"), max_speed = numbers("max_speed"), joint = numbers("joint"), limb = numbers("limb"),
                touch_body = numbers("touch_body"), pairs = numbers("collision_pairs");
  const std::size_t bodies = mass.size();
  require(bodies >= 1 && bodies <= kMaxBodies, "table: wrong number of bodies");
  for (const Doubles* field : {&parent, &shape, &radius, &half_length, &low, &high, &max_speed, &joint, &limb})
    require(field->size() == bodies, "table: one value per body is needed");
  for (const Doubles* field : {&inertia, &half, &offset, &anchor, &parent_anchor, &axis})
    require(field->size() == 3 * bodies, "table: three values per body are needed");
  require(touch_body.size() == kTouchSensors, "table: four touch sensors are needed");
  Model model;
  model.joint_body.assign(bodies - 1, -1);
  for (std::size_t i = 0; i < bodies; ++i) {
    Body b{};
    const auto triple = [i](const Doubles& from, double to[3]) {
      for (int c = 0; c < 3; ++c) to[c] = from.data()[3 * i + c];
    };
    b.mass = mass.data()[i];
    triple(inertia, b.inertia);
    b.isotropic = b.inertia[0] == b.inertia[1] && b.inertia[1] == b.inertia[2];
    b.parent = static_cast<int>(parent.data()[i]);
    require(i == 0 ? b.parent == -1 : b.parent >= 0 && b.parent < static_cast<int>(i), "table: parents come before children");
    b.shape = static_cast<Shape>(static_cast<int>(shape.data()[i]));
    triple(half, b.half);
    b.radius = radius.data()[i];
    b.half_length = half_length.data()[i];
    triple(offset, b.offset);
    triple(anchor, b.anchor);
    triple(parent_anchor, b.parent_anchor);
    triple(axis, b.axis);
    b.low = low.data()[i];
    b.high = high.data()[i];
    b.max_speed = max_speed.data()[i];
    b.joint = static_cast<int>(joint.data()[i]);
    b.limb = static_cast<int>(limb.data()[i]);
    require(b.limb >= -1 && b.limb < kLimbs, "table: unknown limb");
    b.touch = -1;
    if (i > 0) {
      require(b.joint >= 0 && b.joint < static_cast<int>(bodies) - 1 && model.joint_body[b.joint] == -1, "table: joints out of order");
      model.joint_body[b.joint] = static_cast<int>(i);
    }
    model.bodies.push_back(b);
  }
  for (int t = 0; t < kTouchSensors; ++t) {
    model.touch_body[t] = static_cast<int>(touch_body.data()[t]);
    require(model.touch_body[t] < static_cast<int>(bodies), "table: unknown touch body");
    if (model.touch_body[t] >= 0) model.bodies[model.touch_body[t]].touch = t;
  }
  for (std::size_t k = 0; k + 1 < pairs.size(); k += 2) {
    const int a = static_cast<int>(pairs.data()[k]), b = static_cast<int>(pairs.data()[k + 1]);
    require(a >= 0 && b >= 0 && a < static_cast<int>(bodies) && b < static_cast<int>(bodies), "table: unknown collision pair");
    model.collision_pairs.emplace_back(a, b);
  }
  return model;
}

const std::uint8_t* lanes_of(const Batch& batch, const std::optional<Bytes>& mask) {
  if (!mask) return nullptr;
  require(mask->size() == static_cast<std::size_t>(batch.size()), "mask: one value per environment is needed");
  return mask->data();
}

nb::ndarray<nb::numpy, double> view(std::vector<double>& data, std::initializer_list<std::size_t> shape, nb::handle owner) {
  return nb::ndarray<nb::numpy, double>(data.data(), shape, owner);
}

}  // namespace

void bind_protocol(nb::module_& m);  // protocol_bindings.cpp

NB_MODULE(_core, m) {
  bind_protocol(m);
  nb::class_<Batch>(m, "Batch")
      .def("__init__",
           [](Batch* self, const nb::dict& table, int n, int threads, int digits, bool self_collision, const std::string& kernel) {
             const Kernel* chosen = kernel.empty() ? &best_kernel() : find_kernel(kernel.c_str());
             if (chosen == nullptr) throw nb::value_error(("kernel: '" + kernel + "' is unknown or does not run on this processor").c_str());
             require(n >= 1 && threads >= 1, "n and threads must be positive");
             new (self) Batch(make_model(table), n, threads, digits, self_collision, *chosen);
           })
      .def("step",
           [](Batch& self, const Doubles& speeds, const std::optional<Bytes>& mask) {
             require(speeds.size() == static_cast<std::size_t>(self.size()) * self.model().joint_count(), "speeds: wrong shape");
             const std::uint8_t* lanes = lanes_of(self, mask);
             const double* data = speeds.data();
             nb::gil_scoped_release release;
             return self.step(data, lanes);
           }, nb::arg("speeds"), nb::arg("mask").none())
      .def("drive",
           [](Batch& self, const Doubles& targets, double gain, const Doubles& max_speed, const std::optional<Bytes>& mask) {
             const std::size_t joints = static_cast<std::size_t>(self.model().joint_count());
             require(targets.size() == self.size() * joints && max_speed.size() == joints, "targets, max_speed: wrong shape");
             const std::uint8_t* lanes = lanes_of(self, mask);
             const double *data = targets.data(), *limits = max_speed.data();
             nb::gil_scoped_release release;
             return self.drive(data, gain, limits, lanes);
           }, nb::arg("targets"), nb::arg("gain"), nb::arg("max_speed"), nb::arg("mask").none())
      .def("begin_drive",
           [](Batch& self, const Doubles& targets, double gain, const Doubles& max_speed, int first) {
             const std::size_t joints = static_cast<std::size_t>(self.model().joint_count());
             const int count = static_cast<int>(targets.size() / joints), end = first + count;
             require(targets.size() == count * joints && max_speed.size() == joints, "targets, max_speed: wrong shape");
             require(first >= 0 && count >= 1 && end <= self.size() && first % Batch::kWhole == 0 && (end % Batch::kWhole == 0 || end == self.size()),
                     "rows: out of range, or part of a group");
             return self.begin_drive(targets.data(), gain, max_speed.data(), first, count);
           }, nb::arg("targets"), nb::arg("gain"), nb::arg("max_speed"), nb::arg("first"))
      .def("finish_drive",
           [](Batch& self, int first) {
             nb::gil_scoped_release release;
             return self.finish_drive(first);
           }, nb::arg("first"))
      .def_ro_static("whole", &Batch::kWhole)
      .def("reset", [](Batch& self, const std::optional<Bytes>& mask) { self.reset(lanes_of(self, mask)); }, nb::arg("mask").none())
      .def("beam",
           [](Batch& self, const Doubles& position, const Doubles& yaw_deg, const std::optional<Bytes>& mask) {
             require(position.size() == 3u * self.size() && yaw_deg.size() == static_cast<std::size_t>(self.size()), "beam: wrong shape");
             self.beam(position.data(), yaw_deg.data(), lanes_of(self, mask));
           }, nb::arg("position"), nb::arg("yaw_deg"), nb::arg("mask").none())
      .def("set_bodies",
           [](Batch& self, const Doubles& bodies, const std::optional<Bytes>& mask) {
             require(bodies.size() == static_cast<std::size_t>(self.size()) * self.model().body_count() * Batch::kBodyState,
                     "bodies: wrong shape");
             self.set_bodies(bodies.data(), lanes_of(self, mask));
           }, nb::arg("bodies"), nb::arg("mask").none())
      .def("set_enabled",
           [](Batch& self, const Bytes& enabled, const std::optional<Bytes>& mask) {
             require(enabled.size() == static_cast<std::size_t>(self.size()) * self.model().body_count(), "enabled: wrong shape");
             self.set_enabled(enabled.data(), lanes_of(self, mask));
           }, nb::arg("enabled"), nb::arg("mask").none())
      .def("get_bodies",
           [](const Batch& self, Output out) {
             require(out.size() == static_cast<std::size_t>(self.size()) * self.model().body_count() * Batch::kBodyState, "out: wrong shape");
             self.get_bodies(out.data());
           })
      .def("get_enabled",
           [](const Batch& self, ByteOutput out) {
             require(out.size() == static_cast<std::size_t>(self.size()) * self.model().body_count(), "out: wrong shape");
             self.get_enabled(out.data());
           })
      .def("centre_of_mass",
           [](const Batch& self, Output out) {
             require(out.size() == 3u * self.size(), "out: wrong shape");
             self.centre_of_mass(out.data());
           })
      .def("centre_of_mass_from_angles",
           [](const Batch& self, const Doubles& angles_deg, Output out) {
             const std::size_t n = angles_deg.size() / self.model().joint_count();
             require(angles_deg.size() == n * self.model().joint_count() && out.size() == 3 * n, "angles_deg: wrong shape");
             centre_of_mass_from_angles(self.model(), angles_deg.data(), static_cast<int>(n), out.data());
           })
      .def("snapshot",
           [](const Batch& self, int environment, ByteOutput out) {
             require(environment >= 0 && environment < self.size() && out.size() == sizeof(Environment), "snapshot: wrong shape");
             const Environment state = self.load(environment);
             std::memcpy(out.data(), &state, sizeof state);
           })
      .def("restore",
           [](Batch& self, int environment, const Bytes& from) {
             require(environment >= 0 && environment < self.size() && from.size() == sizeof(Environment), "snapshot: wrong shape");
             Environment state;
             std::memcpy(static_cast<void*>(&state), from.data(), sizeof state);
             self.restore(environment, state);
           })
      .def("restore_from",
           [](Batch& self, const Index& rows, const Bytes& states, const Index& chosen) {
             const std::int64_t count = static_cast<std::int64_t>(states.size() / sizeof(Environment));
             require(states.size() == static_cast<std::size_t>(count) * sizeof(Environment) && rows.size() == chosen.size(), "states: wrong shape");
             for (std::size_t k = 0; k < rows.size(); ++k)
               require(rows.data()[k] >= 0 && rows.data()[k] < self.size() && chosen.data()[k] >= 0 && chosen.data()[k] < count,
                       "rows, chosen: out of range");
             for (std::size_t k = 0; k < rows.size(); ++k) {
               Environment state;
               std::memcpy(static_cast<void*>(&state), states.data() + static_cast<std::size_t>(chosen.data()[k]) * sizeof state, sizeof state);
               self.restore(static_cast<int>(rows.data()[k]), state);
             }
           }, nb::arg("rows"), nb::arg("states"), nb::arg("chosen"))
      .def_prop_ro("threads", [](const Batch& self) { return reinterpret_cast<std::uintptr_t>(self.threads()); })
      .def_prop_ro("kinematics", [](const Batch& self) { return reinterpret_cast<std::uintptr_t>(self.kinematics()); })
      .def_prop_ro("snapshot_size", [](const Batch&) { return sizeof(Environment); })
      .def_prop_ro("kernel", [](const Batch& self) { return self.kernel().name; })
      .def_prop_ro("statistics",
                   [](const Batch& self) {
                     const Statistics s = self.statistics();
                     return nb::make_tuple(s.steps, s.solves, s.fallback);
                   })
      .def("views", [](nb::handle self) {
        Batch& batch = nb::cast<Batch&>(self);
        BatchArrays& p = batch.arrays();
        const std::size_t n = batch.size(), joints = batch.model().joint_count();
        nb::dict views;
        views["joint_angles"] = view(p.joint_angles, {n, joints}, self);
        views["gyro"] = view(p.gyro, {n, 3}, self);
        views["accel"] = view(p.accel, {n, 3}, self);
        views["foot_right"] = view(p.touch[0], {n, 6}, self);
        views["foot_left"] = view(p.touch[1], {n, 6}, self);
        views["toe_right"] = view(p.touch[2], {n, 6}, self);
        views["toe_left"] = view(p.touch[3], {n, 6}, self);
        views["time"] = view(p.time, {n}, self);
        views["torso_position"] = view(p.torso_position, {n, 3}, self);
        views["torso_rotation"] = view(p.torso_rotation, {n, 3, 3}, self);
        return views;
      });
}
