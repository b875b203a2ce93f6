// Python bindings of the protocol; naosim.simspark.protocol, .client and .server document the arguments.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <memory>

#include "exchange_bindings.hpp"
#include "protocol.hpp"

namespace nb = nanobind;
using namespace naosim::protocol;

using Doubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Output = nb::ndarray<double, nb::c_contig, nb::device::cpu>;
using Bytes = nb::ndarray<const std::uint8_t, nb::c_contig, nb::device::cpu>;

namespace {

constexpr int kDeepest = 16;

void require(bool holds, const char* what) {
  if (!holds) throw nb::value_error(what);
}

std::string_view view(const nb::bytes& bytes) { return {bytes.c_str(), bytes.size()}; }
nb::bytes bytes(const std::string& text) { return nb::bytes(text.data(), text.size()); }
nb::object text(std::string_view word) {
  return nb::steal(PyUnicode_DecodeLatin1(word.data(), static_cast<Py_ssize_t>(word.size()), nullptr));
}

[[noreturn]] void malformed(const Cursor& cursor, const std::string& what) {
  throw nb::value_error(("byte " + std::to_string(cursor.offset()) + ": " + what).c_str());
}

// The rest of a list whose "(" and tag have been read, as a list of words and lists.
nb::list rest_of(Cursor& cursor, int depth) {
  if (depth > kDeepest) malformed(cursor, "expressions nest too deeply");
  nb::list items;
  std::string_view word;
  for (;;) {
    if (cursor.at_list()) {
      cursor.enter();
      items.append(nb::tuple(rest_of(cursor, depth + 1)));
    } else if (cursor.atom(word)) {
      items.append(text(word));
    } else if (cursor.done()) {
      malformed(cursor, "an expression is not closed");
    } else {
      cursor.leave();
      return items;
    }
  }
}

// Reads an agent's commands: hinge speeds go to `speeds`, everything else is returned.
class CommandReader {
 public:
  explicit CommandReader(const std::vector<std::string>& effectors) : names_(effectors) {
    for (std::size_t k = 0; k < names_.size(); ++k) index_[names_[k]] = static_cast<int>(k);
  }

  nb::list read(const nb::bytes& message, const Output& speeds) const {
    require(speeds.size() == names_.size(), "speeds: wrong shape");
    Cursor cursor(view(message));
    nb::list others;
    std::vector<std::pair<int, double>> commands;
    std::string_view tag;
    while (!cursor.done()) {
      if (!cursor.enter(tag)) malformed(cursor, "'(' expected");
      const auto found = index_.find(tag);
      if (found == index_.end()) {
        nb::list items = rest_of(cursor, 1);
        if (!tag.empty()) items.insert(0, text(tag));
        others.append(nb::tuple(items));
        continue;
      }
      double speed;
      const std::string& name = names_[found->second];
      if (!cursor.number(speed) || !std::isfinite(static_cast<float>(speed))) malformed(cursor, name + ": the speed is not a number");
      if (cursor.at_list() || !cursor.leave()) malformed(cursor, name + ": the expression is not closed");
      commands.emplace_back(found->second, speed);
    }
    for (const auto& [joint, speed] : commands) speeds.data()[joint] = speed;
    return others;
  }

 private:
  std::vector<std::string> names_;
  std::unordered_map<std::string_view, int> index_;
};

using Named = std::vector<std::pair<std::string, std::tuple<double, double, double>>>;

std::vector<Vision::Landmark> landmarks(const Named& named) {
  std::vector<Vision::Landmark> out;
  for (const auto& [name, at] : named) out.push_back({name, {std::get<0>(at), std::get<1>(at), std::get<2>(at)}});
  return out;
}

nb::ndarray<nb::numpy, double> array(std::vector<double>& data, std::initializer_list<std::size_t> shape, nb::handle owner) {
  return nb::ndarray<nb::numpy, double>(data.data(), shape, owner);
}

}  // namespace

void bind_protocol(nb::module_& m) {
  nb::class_<CommandReader>(m, "CommandReader").def(nb::init<const std::vector<std::string>&>()).def("read", &CommandReader::read);

  nb::class_<PerceptorWriter>(m, "PerceptorWriter")
      .def("__init__",
           [](PerceptorWriter* self, const std::vector<std::tuple<std::string, std::string, int>>& items, int digits) {
             std::vector<PerceptorWriter::Item> list;
             for (const auto& [kind, name, index] : items) {
               require(kind == "j" || kind == "t" || kind == "s", "items: unknown kind");
               require(index >= 0 && (kind != "t" || index < 4), "items: index out of range");
               list.push_back({kind[0], name, index});
             }
             require(digits >= 0 && digits <= 9, "digits: out of range");
             new (self) PerceptorWriter(std::move(list), digits);
           })
      .def("write",
           [](const PerceptorWriter& self, const nb::bytes& head, const nb::bytes& see, const Doubles& gyro, const Doubles& accel,
              const Doubles& angles, const Doubles& touch) {
             require(gyro.size() == 3 && accel.size() == 3 && touch.size() == 24 && angles.size() >= 22, "perceptors: wrong shape");
             const double* sensors[4] = {touch.data(), touch.data() + 6, touch.data() + 12, touch.data() + 18};
             return bytes(self.write(view(head), view(see), gyro.data(), accel.data(), angles.data(), sensors));
           });

  nb::class_<Vision>(m, "Vision")
      .def("__init__",
           [](Vision* self, const Named& named, const Doubles& lines, int digits, std::uint64_t seed, bool noise) {
             require(lines.size() % 6 == 0, "lines: wrong shape");
             std::vector<Vision::Line> list(lines.size() / 6);
             for (std::size_t k = 0; k < lines.size(); ++k) list[k / 6][k % 6] = lines.data()[k];
             new (self) Vision(landmarks(named), std::move(list), digits, seed, noise);
           })
      .def("see",
           [](Vision& self, const Doubles& position, const Doubles& rotation, const Named& moving, const std::string& own,
              const Named& parts) {
             require(position.size() == 3 && rotation.size() == 9, "head: wrong shape");
             return bytes(self.see(position.data(), rotation.data(), landmarks(moving), own, landmarks(parts)));
           });

  nb::class_<SceneWriter>(m, "SceneWriter")
      .def("__init__",
           [](SceneWriter* self, const std::vector<std::tuple<std::string, std::string, int>>& steps, int bodies) {
             std::vector<SceneWriter::Step> list;
             for (const auto& [full, incremental, body] : steps) {
               require(body >= SceneWriter::kClose && body < bodies, "steps: unknown body");
               list.push_back({full, incremental, body});
             }
             new (self) SceneWriter(std::move(list), bodies);
           })
      .def("write", [](SceneWriter& self, const nb::bytes& head, bool full, const Doubles& poses) {
        require(poses.size() == 13u * self.bodies(), "poses: wrong shape");
        return bytes(self.write(view(head), full, poses.data()));
      });

  nb::class_<SceneReader>(m, "SceneReader")
      .def(nb::init<>())
      .def("read",
           [](SceneReader& self, const nb::bytes& frame) {
             const std::string problem = self.read(view(frame));
             if (!problem.empty()) throw nb::value_error(problem.c_str());
           })
      .def_prop_ro("time", &SceneReader::time)
      .def_prop_ro("play_mode", &SceneReader::play_mode)
      .def_prop_ro("robots", &SceneReader::robots)
      .def("torso",
           [](const SceneReader& self, int side, int number, Output position, Output rotation) {
             require(position.size() == 3 && rotation.size() == 9, "out: wrong shape");
             return self.torso(side, number, position.data(), rotation.data());
           })
      .def("ball", [](const SceneReader& self, Output position) {
        require(position.size() == 3, "out: wrong shape");
        return self.ball(position.data());
      });

  auto exchange = nb::class_<SparkExchange>(m, "Exchange");
  exchange
      .def("__init__",
           [](SparkExchange* self, int n, const std::vector<std::string>& joints, const std::vector<std::string>& effectors,
              const std::vector<std::string>& landmarks) {
             require(n >= 1 && !joints.empty() && joints.size() == effectors.size(), "one effector per joint is needed");
             new (self) SparkExchange(n, joints, effectors, landmarks);
           })
      .def("choose", [](SparkExchange& self, int row, int side, int number) { self.choose(row_of(self, row), side, number); })
      .def("counts",
           [](const SparkExchange& self, int row) {
             row_of(self, row);
             return nb::make_tuple(self.messages_of(row), self.frames_of(row), self.joints_seen(row), self.torso_seen(row));
           })
      .def("scene_complete", [](const SparkExchange& self, int row) { return self.scene_complete(row_of(self, row)); })
      .def("game",
           [](const SparkExchange& self, int row) {
             const GameState& game = self.game(row_of(self, row));
             return nb::make_tuple(game.side, game.uniform_number, text(game.play_mode));
           })
      .def("views", [](nb::handle self) {
        SparkExchange& e = nb::cast<SparkExchange&>(self);
        const std::size_t n = static_cast<std::size_t>(e.size());
        nb::dict views;
        views["joint_angles"] = array(e.joint_angles, {n, e.joint_count()}, self);
        views["gyro"] = array(e.gyro, {n, 3}, self);
        views["accel"] = array(e.accel, {n, 3}, self);
        views["foot_right"] = array(e.touch[0], {n, 6}, self);
        views["foot_left"] = array(e.touch[1], {n, 6}, self);
        views["toe_right"] = array(e.touch[2], {n, 6}, self);
        views["toe_left"] = array(e.touch[3], {n, 6}, self);
        views["time"] = array(e.time, {n}, self);
        views["game_time"] = array(e.game_time, {n}, self);
        views["torso_position"] = array(e.torso_position, {n, 3}, self);
        views["torso_rotation"] = array(e.torso_rotation, {n, 3, 3}, self);
        views["ball"] = array(e.ball, {n, 3}, self);
        views["vision"] = array(e.vision, {n, e.vision.size() / n}, self);
        return views;
      });
  bind_exchange(exchange);
}
