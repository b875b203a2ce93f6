// The module naosprint._compiled; naosprint.terms and naosprint.rl.normalization document it.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <string>
#include <tuple>
#include <vector>

#include "normalization.hpp"
#include "operations.hpp"
#include "program.hpp"

namespace nb = nanobind;

using Any = nb::ndarray<nb::device::cpu>;
using Doubles = nb::ndarray<double, nb::c_contig, nb::device::cpu>;
using Inputs = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Floats = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using FloatInputs = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Index = nb::ndarray<const std::int64_t, nb::c_contig, nb::device::cpu>;
using Flags = nb::ndarray<const bool, nb::c_contig, nb::device::cpu>;

namespace naosprint {
namespace {

void require(bool holds, const std::string& what) {
  if (!holds) throw nb::value_error(what.c_str());
}

// A view of an array with one row per robot, the numbers of a row side by side.
template <class Number>
Table<Number> table_of(const Any& array, const std::string& name) {
  require(array.ndim() >= 1 && array.dtype() == nb::dtype<Number>(), name + ": wrong type");
  std::int64_t width = 1;
  for (std::size_t axis = array.ndim(); axis-- > 1;) {
    require(array.stride(axis) == width || array.shape(axis) <= 1, name + ": the numbers of a row must be side by side");
    width *= static_cast<std::int64_t>(array.shape(axis));
  }
  return {static_cast<Number*>(array.data()), static_cast<std::ptrdiff_t>(array.stride(0)), static_cast<std::int64_t>(array.shape(0)),
          static_cast<int>(width)};
}

struct OperationHolder {
  std::shared_ptr<Operation> operation;
  std::int64_t rows = -1;
  std::vector<Any> arrays;  // keeps them
};

AnyTable any_table(const Any& array, const std::string& name) {
  if (array.dtype() == nb::dtype<double>()) return table_of<double>(array, name);
  if (array.dtype() == nb::dtype<std::int64_t>()) return table_of<std::int64_t>(array, name);
  return table_of<bool>(array, name);
}

// Function, arguments, width, constants, array of a source or None, and address of a function of another module.
using GivenNode = std::tuple<std::string, std::vector<int>, int, std::vector<double>, std::optional<Any>, std::uint64_t>;
using Nodes = std::vector<GivenNode>;
using GivenStore = std::tuple<Any, Nodes, Nodes>;

OperationHolder make_holder(const Nodes& value, const std::vector<GivenStore>& stores) {
  OperationHolder holder;
  holder.operation = std::make_shared<Operation>();
  const auto kept = [&](const Any& array, const std::string& name) {
    const AnyTable table = any_table(array, name);
    const std::int64_t rows = std::visit([](const auto& each) { return each.rows; }, table);
    require(holder.rows < 0 || holder.rows == rows, name + ": wrong number of robots");
    holder.rows = rows;
    holder.arrays.push_back(array);
    return table;
  };
  const auto expressions = [&](const Nodes& given) {
    std::vector<Node> nodes;
    for (const auto& [function, arguments, width, constants, array, address] : given)
      nodes.push_back({function, arguments, width, constants, array ? kept(*array, "function " + function) : AnyTable(), address});
    return given.empty() ? std::vector<Expression>() : std::vector<Expression>{Expression(nodes)};
  };
  try {
    holder.operation->value = expressions(value);
    for (const auto& [target, begin, update] : stores) {
      Operation::Store store{kept(target, "store"), expressions(begin), expressions(update)};
      const int width = std::visit([](const auto& table) { return table.width; }, store.target);
      for (const auto* some : {&store.begin, &store.update})
        for (const Expression& each : *some) require(each.width() == width || each.width() == 1, "store: wrong width");
      holder.operation->stores.push_back(std::move(store));
    }
  } catch (const std::invalid_argument& error) {
    throw nb::value_error(error.what());
  }
  return holder;
}

// A program, and the targets of its actions.
class Step {
 public:
  Step(const std::vector<OperationHolder>& measurements, const nb::list& blocks, const nb::list& terms, const nb::list& ends, const nb::dict& arrays,
       double scale, const std::vector<double>& nominal, bool around_nominal, const std::vector<std::vector<double>>& joints, int width,
       int seen) {
    const auto given = [&](const char* name) { return nb::cast<Any>(arrays[name]); };
    const auto reals = [&](const char* name) { return kept(table_of<double>(given(name), name)); };
    const auto flags = [&](const char* name) { return kept(table_of<bool>(given(name), name)); };
    auto& a = program_.arrays;
    a.steps = table_of<std::int64_t>(given("steps"), "steps");
    n_ = a.steps.rows;
    a.observations = reals("observations");
    a.values = reals("values");
    a.rewards = reals("rewards");
    a.actions = reals("actions");
    a.previous_actions = reals("previous_actions");
    a.targets = reals("targets");
    a.terminated = flags("terminated");
    a.truncated = flags("truncated");
    a.failed = flags("failed");
    a.lost = flags("lost");
    a.short_episode = flags("short");
    arrays_ = arrays;
    program_.scale = scale;
    program_.width = width;
    program_.seen = seen;
    require(width > 0 && seen % width == 0 && seen <= a.observations.width, "observations: not a whole number of steps");
    program_.nominal = nominal;
    program_.around_nominal = around_nominal;
    require(static_cast<int>(nominal.size()) == a.targets.width && static_cast<int>(joints.size()) == a.actions.width &&
                a.previous_actions.width == a.actions.width,
            "joints: wrong shape");
    for (const std::vector<double>& joint : joints) {
      require(joint.size() == 6 && joint[0] >= 0 && joint[0] < static_cast<double>(nominal.size()), "joints: index out of range");
      program_.joints.push_back({static_cast<int>(joint[0]), joint[1], joint[2], joint[3], joint[4], joint[5]});
    }
    for (const OperationHolder& each : measurements) program_.measurements.push_back(kept(each));
    for (nb::handle each : blocks) {
      const auto [holder, first, rates, angular, value] = nb::cast<std::tuple<OperationHolder, int, bool, bool, int>>(each);
      const int columns = holder.operation->width() * (rates ? 2 : 1);
      require(first >= 0 && first + columns <= a.observations.width, "blocks: column out of range");
      require(!rates || (value >= 0 && value + holder.operation->width() <= a.values.width), "blocks: value out of range");
      program_.blocks.push_back({kept(holder), first, rates, angular, value});
    }
    for (nb::handle each : terms) {
      const auto [holder, weight] = nb::cast<std::tuple<OperationHolder, double>>(each);
      require(holder.operation->width() == 1, "terms: one number per robot is needed");
      program_.terms.push_back({kept(holder), weight});
    }
    for (nb::handle each : ends) {
      const auto [flag, reached, failure] = nb::cast<std::tuple<Any, Any, bool>>(each);
      program_.ends.push_back({kept(table_of<bool>(flag, "flag")), kept(table_of<bool>(reached, "reached")), failure});
      flags_.push_back(flag);
      flags_.push_back(reached);
    }
  }

  template <class Array>
  void act(std::int64_t first, const Array& actions) const {
    require(actions.ndim() == 2 && static_cast<int>(actions.shape(1)) == program_.arrays.actions.width, "actions: wrong shape");
    require(first >= 0 && first + static_cast<std::int64_t>(actions.shape(0)) <= n_, "rows: out of range");
    program_.act(first, static_cast<int>(actions.shape(0)), actions.data());
  }

  void step(std::int64_t first, int count, const std::optional<Flags>& lost, std::int64_t max_steps, std::int64_t short_steps,
            bool horizon_is_terminal, std::uint64_t threads) const {
    require(first >= 0 && count >= 0 && first + count <= n_, "rows: out of range");
    require(!lost || static_cast<int>(lost->size()) == count, "lost: one flag per robot is needed");
    const bool* gone = lost ? lost->data() : nullptr;
    nb::gil_scoped_release release;
    program_.step(first, count, gone, {max_steps, short_steps, horizon_is_terminal}, threads);
  }

  void begin(const Index& rows) const {
    for (std::size_t k = 0; k < rows.size(); ++k) require(rows.data()[k] >= 0 && rows.data()[k] < n_, "rows: out of range");
    program_.begin({rows.data(), 0, static_cast<int>(rows.size())});
  }

 private:
  template <class Number>
  const Table<Number>& kept(const Table<Number>& table) const {
    require(table.rows == n_, "arrays: one row per robot is needed");
    return table;
  }
  std::shared_ptr<Operation> kept(const OperationHolder& holder) {
    require(holder.rows == n_ || holder.rows < 0, "operations: one row per robot is needed");  // constants have none
    holders_.push_back(holder);
    return holder.operation;
  }

  Program program_;
  std::int64_t n_ = 0;
  nb::dict arrays_;
  std::vector<OperationHolder> holders_;
  std::vector<Any> flags_;
};

// Sum of the twelve 16-bit numbers in three hashes, as a normal number.
double normal(std::uint64_t seed, std::uint64_t stream, std::uint64_t draw, std::uint64_t number) {
  std::uint64_t sum = 0;
  for (std::uint64_t part = 0; part < 3; ++part) {
    const std::uint64_t bits = hashed(seed, stream, draw, 3 * number + part);
    sum += (bits & 0xFFFF) + (bits >> 16 & 0xFFFF) + (bits >> 32 & 0xFFFF) + (bits >> 48);
  }
  return (static_cast<double>(sum) + 6.0) / 65536.0 - 6.0;
}

// Moments of samples, on the threads at an address. The arrays are kept and changed.
class RunningMoments {
 public:
  RunningMoments(const Doubles& mean, const Doubles& variance, const Doubles& count, const std::optional<Index>& index,
                 const std::optional<Inputs>& sign, std::uint64_t threads)
      : arrays_{mean, variance, count}, index_(index), sign_(sign), threads_(threads) {
    require(mean.size() == variance.size() && mean.size() == count.size(), "moments: wrong shape");
    moments_ = {mean.data(), variance.data(), count.data(), static_cast<int>(mean.size())};
    require(index.has_value() == sign.has_value() && (!index || (index->size() == mean.size() && sign->size() == mean.size())),
            "mirror: wrong shape");
    for (std::size_t j = 0; index && j < index->size(); ++j)
      require(index->data()[j] >= 0 && index->data()[j] < moments_.width, "mirror: out of range");
  }

  void merge(const Inputs& samples) const {
    require(samples.ndim() == 2 && samples.shape(0) > 0 && static_cast<int>(samples.shape(1)) == moments_.width, "samples: wrong shape");
    naosprint::merge(moments_, {index_ ? index_->data() : nullptr, sign_ ? sign_->data() : nullptr}, samples.data(),
                     static_cast<std::int64_t>(samples.shape(0)), threads_);
  }

  bool standardize(const Inputs& samples, double clip, const Floats& out) const {
    require(samples.ndim() == 2 && static_cast<int>(samples.shape(1)) == moments_.width && out.size() == samples.size(), "samples: wrong shape");
    return naosprint::standardize(moments_, samples.data(), static_cast<std::int64_t>(samples.shape(0)), clip, out.data(), threads_);
  }

  void scale_rewards(const Doubles& returns, const Inputs& rewards, const Flags& dones, double gamma, double clip, const Floats& out) const {
    require(moments_.width == 1 && returns.size() == rewards.size() && dones.size() == rewards.size() && out.size() == rewards.size(),
            "rewards: wrong shape");
    naosprint::scale_rewards(moments_, returns.data(), rewards.data(), dones.data(), static_cast<std::int64_t>(rewards.size()), gamma, clip,
                             out.data());
  }

 private:
  std::vector<Doubles> arrays_;
  std::optional<Index> index_;
  std::optional<Inputs> sign_;
  std::uint64_t threads_;
  Moments moments_;
};

}  // namespace
}  // namespace naosprint

NB_MODULE(_compiled, m) {
  using namespace naosprint;
  nb::class_<OperationHolder>(m, "Operation")
      .def("__init__",
           [](OperationHolder* self, const Nodes& value, const std::vector<GivenStore>& stores) {
             new (self) OperationHolder(make_holder(value, stores));
           },
           nb::arg("value"), nb::arg("stores"))
      .def_prop_ro("width", [](const OperationHolder& self) { return self.operation->width(); });
  nb::class_<Step>(m, "Step")
      .def(nb::init<const std::vector<OperationHolder>&, const nb::list&, const nb::list&, const nb::list&, const nb::dict&, double,
                    const std::vector<double>&, bool, const std::vector<std::vector<double>>&, int, int>(),
           nb::arg("measurements"), nb::arg("blocks"), nb::arg("terms"), nb::arg("ends"), nb::arg("arrays"), nb::arg("scale"),
           nb::arg("nominal"), nb::arg("around_nominal"), nb::arg("joints"), nb::arg("width"), nb::arg("seen"))
      .def("act", &Step::act<Inputs>, nb::arg("first"), nb::arg("actions"))  // first: what is neither type becomes this one
      .def("act", &Step::act<FloatInputs>, nb::arg("first"), nb::arg("actions"))
      .def("step", &Step::step, nb::arg("first"), nb::arg("count"), nb::arg("lost").none(), nb::arg("max_steps"), nb::arg("short_steps"),
           nb::arg("horizon_is_terminal"), nb::arg("threads"))
      .def("begin", &Step::begin, nb::arg("rows"));
  nb::class_<RunningMoments>(m, "Moments")
      .def(nb::init<const Doubles&, const Doubles&, const Doubles&, const std::optional<Index>&, const std::optional<Inputs>&, std::uint64_t>(),
           nb::arg("mean"), nb::arg("variance"), nb::arg("count"), nb::arg("index").none(), nb::arg("sign").none(), nb::arg("threads"))
      .def("merge", &RunningMoments::merge, nb::arg("samples"))
      .def("standardize", &RunningMoments::standardize, nb::arg("samples"), nb::arg("clip"), nb::arg("out"))
      .def("scale_rewards", &RunningMoments::scale_rewards, nb::arg("returns"), nb::arg("rewards"), nb::arg("dones"), nb::arg("gamma"),
           nb::arg("clip"), nb::arg("out"));
  m.def("normal",
        [](std::uint64_t seed, const Index& streams, const Index& draws, const Doubles& out) {
          require(out.ndim() == 2 && out.shape(0) == streams.size() && streams.size() == draws.size(), "streams, draws: one per row is needed");
          const std::size_t width = out.shape(1);
          for (std::size_t k = 0; k < streams.size(); ++k)
            for (std::size_t c = 0; c < width; ++c)
              out.data()[k * width + c] =
                  normal(seed, static_cast<std::uint64_t>(streams.data()[k]), static_cast<std::uint64_t>(draws.data()[k]), c);
        },
        nb::arg("seed"), nb::arg("streams"), nb::arg("draws"), nb::arg("out"));
  m.def("add_normal",
        [](const Doubles& values, const Inputs& deviations, const Flags& where, std::uint64_t seed, const Index& streams, const Index& draws) {
          const std::size_t rows = streams.size();
          require(values.ndim() == 2 && values.shape(0) == rows && draws.size() == rows && deviations.size() == rows && where.size() == rows,
                  "deviations, where, streams, draws: one per row is needed");
          const std::size_t width = values.shape(1);
          for (std::size_t k = 0; k < rows; ++k)
            for (std::size_t c = 0; where.data()[k] && c < width; ++c)
              values.data()[k * width + c] +=
                  deviations.data()[k] *
                  normal(seed, static_cast<std::uint64_t>(streams.data()[k]), static_cast<std::uint64_t>(draws.data()[k]), c);
        },
        nb::arg("values").noconvert(), nb::arg("deviations"), nb::arg("where"), nb::arg("seed"), nb::arg("streams"), nb::arg("draws"));
}
