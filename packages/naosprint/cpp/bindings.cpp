// The module naosprint.rl._kernel; naosprint.rl.gradients documents it.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <optional>
#include <string>
#include <thread>
#include <tuple>
#include <vector>

#include "adam_bindings.hpp"
#include "forward_bindings.hpp"
#include "network.hpp"

namespace nb = nanobind;

using Floats = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using Index = nb::ndarray<const std::int64_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Signs = nb::ndarray<const double, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Mirrors = std::vector<std::tuple<Index, Signs>>;

namespace naosprint {
namespace {

void require(bool holds, const char* what) {
  if (!holds) throw nb::value_error(what);
}

Mirror mirror_of(const Index& index, const Signs& sign) {
  require(index.size() == sign.size(), "mirrors: an index and a sign for each number");
  Mirror mirror;
  for (std::size_t i = 0; i < index.size(); ++i) {
    const std::int64_t other = index.data()[i];
    require(other >= 0 && other < static_cast<std::int64_t>(index.size()) && index.data()[other] == static_cast<std::int64_t>(i) &&
                sign.data()[other] == sign.data()[i] && std::fabs(sign.data()[i]) == 1.0,
            "mirrors: not an exchange of pairs with signs");
    const int left = static_cast<int>(i), right = static_cast<int>(other);
    if (left < right) mirror.pairs.push_back({left, right, static_cast<float>(sign.data()[i])});
    if (left == right) (sign.data()[i] > 0.0 ? mirror.even : mirror.odd).push_back(left);
  }
  return mirror;
}

// Pointers to one network's parameters and gradients.
class Gradients {
 public:
  // Weight, bias, gradient of the weight, gradient of the bias of each layer. The arrays must outlive this object, which keeps them.
  Gradients(std::vector<std::tuple<Floats, Floats, Floats, Floats>> arrays, const Mirrors& mirrors, const std::string& kernel)
      : arrays_(std::move(arrays)) {
    std::vector<Layer>& layers = network_.layers;
    kernel_ = kernel.empty() ? &best_kernel() : find_kernel(kernel.c_str());
    require(kernel_ != nullptr, "kernel: not supported by this processor");
    require(!arrays_.empty(), "layers: at least one is needed");
    for (auto& [weight, bias, weight_gradient, bias_gradient] : arrays_) {
      require(weight.ndim() == 2 && weight_gradient.ndim() == 2 && bias.ndim() == 1 && bias_gradient.ndim() == 1, "layers: wrong shape");
      require(weight.shape(0) == bias.shape(0) && weight.shape(0) == weight_gradient.shape(0) && weight.shape(1) == weight_gradient.shape(1) &&
                  bias.shape(0) == bias_gradient.shape(0),
              "layers: shapes do not match");
      require(layers.empty() || static_cast<int>(weight.shape(1)) == layers.back().outputs, "layers: widths do not match");
      layers.push_back({static_cast<int>(weight.shape(1)), static_cast<int>(weight.shape(0)), weight.data(), bias.data(), weight_gradient.data(),
                         bias_gradient.data()});
    }
    for (const auto& [index, sign] : mirrors) network_.mirrors.push_back(mirror_of(index, sign));
    require(mirrors.empty() || mirrors.size() == layers.size() + 1, "mirrors: one of the inputs and one of each layer's outputs");
    for (std::size_t l = 0; l < mirrors.size(); ++l) {
      const int width = l == 0 ? layers[0].inputs : layers[l - 1].outputs;
      require(static_cast<int>(std::get<0>(mirrors[l]).size()) == width, "mirrors: widths do not match");
      bool plain = l == 0 || l == layers.size() || 2 * static_cast<int>(network_.mirrors[l].pairs.size()) == width;
      if (l > 0 && l < layers.size())
        for (const Mirror::Pair& pair : network_.mirrors[l].pairs) plain = plain && pair.sign > 0.0f;
      require(plain, "mirrors: hidden layers have pairs of sign 1 only");
    }
  }

  // Observations as `actor` and `critic` take them.
  void split(const Floats& observations, const Floats& halves) const {
    require(observations.ndim() == 2 && static_cast<int>(observations.shape(1)) == network_.layers.front().inputs &&
                halves.size() == observations.size(),
            "observations: wrong shape");
    require(!network_.mirrors.empty(), "mirrors: the network is not symmetric");
    naosprint::split(network_.mirrors[0], observations.data(), static_cast<std::int64_t>(observations.shape(0)), halves.data());
  }

  // The gradients of an actor (this) and of a critic, which share nothing: on a thread each if `concurrent`.
  std::tuple<double, double, double, double> both(Gradients& other, const Floats& log_std, std::optional<Floats> log_std_gradient,
                                                  const Floats& observations, const Floats& actions, const Floats& log_probs, const Floats& advantages,
                                                  const Floats& returns, const Index& rows, bool normalize, float clip_range, float coefficient,
                                                  bool concurrent) {
    require(this != &other, "critic: another network is needed");
    const auto [rollout, gradient] = checked(log_std, log_std_gradient, observations, actions, log_probs, advantages, rows, normalize);
    const Rollout values = other.checked(observations, returns, rows);
    const Rows chosen{rows.data(), static_cast<int>(rows.size())};
    nb::gil_scoped_release release;
    ActorResult result{};
    const double value_loss = other.beside(values, chosen, coefficient, concurrent, [&] {
      result = kernel_->actor(network_, log_std.data(), gradient, rollout, chosen, normalize, clip_range, workspace_);
    });
    return {result.loss, result.clipped, result.kl, value_loss};
  }

  // The gradients of an actor (this) that imitates actions, and of a critic.
  std::tuple<double, double> imitation(Gradients& other, const Floats& observations, const Floats& actions, const Floats& returns, const Index& rows,
                                       float coefficient, bool concurrent) {
    require(this != &other, "critic: another network is needed");
    const Rollout shown = checked(observations, actions, rows), values = other.checked(observations, returns, rows);
    const Rows chosen{rows.data(), static_cast<int>(rows.size())};
    nb::gil_scoped_release release;
    double distance = 0.0;
    const double value_loss = other.beside(values, chosen, coefficient, concurrent,
                                           [&] { distance = kernel_->squared(network_, shown, chosen, 1.0f, workspace_); });
    return {distance, value_loss};
  }

  const char* kernel_name() const { return kernel_->name; }

 private:
  std::tuple<Rollout, float*> checked(const Floats& log_std, std::optional<Floats>& log_std_gradient, const Floats& observations, const Floats& actions,
                                      const Floats& log_probs, const Floats& advantages, const Index& rows, bool normalize) const {
    const std::size_t n = observations.shape(0), outputs = static_cast<std::size_t>(network_.layers.back().outputs);
    check(observations, rows);
    require(actions.size() == n * outputs && log_std.size() == outputs && (!log_std_gradient || log_std_gradient->size() == outputs),
            "actions, log_std: wrong shape");
    require(log_probs.size() == n && advantages.size() == n, "log_probs, advantages: wrong shape");
    require(!normalize || rows.size() >= 2, "rows: at least two are needed to normalize advantages");
    return {Rollout{observations.data(), actions.data(), log_probs.data(), advantages.data(), nullptr},
            log_std_gradient ? log_std_gradient->data() : nullptr};
  }

  Rollout checked(const Floats& observations, const Floats& targets, const Index& rows) const {
    check(observations, rows);
    require(targets.size() == observations.shape(0) * static_cast<std::size_t>(network_.layers.back().outputs), "actions, returns: wrong shape");
    return {observations.data(), nullptr, nullptr, nullptr, targets.data()};
  }

  // Compute the squared error's gradient of this critic while an actor learns, on a thread each if `concurrent`; return the error.
  template <typename Learn>
  double beside(const Rollout& values, const Rows& chosen, float coefficient, bool concurrent, const Learn& learn) {
    double value_loss = 0.0;
    const auto learn_values = [&] { value_loss = kernel_->squared(network_, values, chosen, coefficient, workspace_); };
    std::thread thread;
    if (concurrent) thread = std::thread(learn_values);
    learn();
    if (concurrent)
      thread.join();
    else
      learn_values();
    return value_loss;
  }

  void check(const Floats& observations, const Index& rows) const {
    require(observations.ndim() == 2 && static_cast<int>(observations.shape(1)) == network_.layers.front().inputs, "observations: wrong shape");
    require(rows.size() >= 1, "rows: at least one is needed");
    for (std::size_t k = 0; k < rows.size(); ++k)
      require(rows.data()[k] >= 0 && rows.data()[k] < static_cast<std::int64_t>(observations.shape(0)), "rows: out of range");
  }

  std::vector<std::tuple<Floats, Floats, Floats, Floats>> arrays_;
  Network network_;
  const Kernel* kernel_;
  Workspace workspace_;
};

}  // namespace

void split(const Mirror& mirror, const float* rows, std::int64_t count, float* halves) {
  const std::size_t width = 2 * mirror.pairs.size() + mirror.even.size() + mirror.odd.size();
  const std::size_t first = mirror.pairs.size() + mirror.even.size();
  for (; count > 0; --count, rows += width, halves += width) {
    float *even = halves, *odd = halves + first;
    for (const Mirror::Pair& pair : mirror.pairs) {
      const float left = rows[pair.left], right = pair.sign * rows[pair.right];
      *even++ = left + right;
      *odd++ = left - right;
    }
    for (int single : mirror.even) *even++ = rows[single];
    for (int single : mirror.odd) *odd++ = rows[single];
  }
}

float* Workspace::take(std::size_t floats) {
  float* at = memory_.data() + used_;
  used_ += (floats + 15) / 16 * 16;
  return at;
}

void Workspace::reserve(std::size_t floats) {
  if (memory_.size() < floats) memory_.resize(floats);
}

#define NAOSPRINT_DECLARE(isa) \
  namespace isa {              \
  extern const Kernel kernel;  \
  }
NAOSPRINT_DECLARE(generic)
#ifdef NAOSPRINT_HAS_avx2
NAOSPRINT_DECLARE(avx2)
#endif
#ifdef NAOSPRINT_HAS_avx512
NAOSPRINT_DECLARE(avx512)
#endif

namespace {

const Kernel* const kKernels[] = {
#ifdef NAOSPRINT_HAS_avx512
    &avx512::kernel,
#endif
#ifdef NAOSPRINT_HAS_avx2
    &avx2::kernel,
#endif
    &generic::kernel,
};

bool runs_here(const std::string& name) {
#if defined(__x86_64__)
  if (name == "avx512")
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw") &&
           __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512cd");
  if (name == "avx2") return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
#endif
  return name == "generic";
}

}  // namespace

const Kernel& best_kernel() {
  for (const Kernel* kernel : kKernels)
    if (runs_here(kernel->name)) return *kernel;
  return generic::kernel;
}

const Kernel* find_kernel(const char* name) {
  for (const Kernel* kernel : kKernels)
    if (std::string(kernel->name) == name && runs_here(name)) return kernel;
  return nullptr;
}

}  // namespace naosprint

NB_MODULE(_kernel, m) {
  using naosprint::Gradients;
  nb::class_<Gradients>(m, "Gradients")
      .def(nb::init<std::vector<std::tuple<Floats, Floats, Floats, Floats>>, const Mirrors&, const std::string&>(), nb::arg("layers"),
           nb::arg("mirrors"), nb::arg("kernel"))
      .def("split", &Gradients::split, nb::arg("observations"), nb::arg("halves"))
      .def("both", &Gradients::both, nb::arg("critic"), nb::arg("log_std"), nb::arg("log_std_gradient").none(), nb::arg("observations"),
           nb::arg("actions"), nb::arg("log_probs"), nb::arg("advantages"), nb::arg("returns"), nb::arg("rows"), nb::arg("normalize"),
           nb::arg("clip_range"), nb::arg("coefficient"), nb::arg("concurrent"))
      .def("imitation", &Gradients::imitation, nb::arg("critic"), nb::arg("observations"), nb::arg("actions"), nb::arg("returns"), nb::arg("rows"),
           nb::arg("coefficient"), nb::arg("concurrent"))
      .def_prop_ro("kernel", &Gradients::kernel_name);
  m.def("kernels", [] {
    std::vector<std::string> names;
    for (const naosprint::Kernel* kernel : naosprint::kKernels)
      if (naosprint::runs_here(kernel->name)) names.push_back(kernel->name);
    return names;
  });
  naosprint::bind_adam(m);
  naosprint::bind_forward(m);
}
