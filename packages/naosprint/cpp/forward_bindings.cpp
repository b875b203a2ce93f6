// The class Forward of naosprint.rl._kernel; naosprint.rl.forward documents it.
#include "forward_bindings.hpp"

#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <optional>
#include <tuple>

#include "forward.hpp"
#include "network.hpp"
#include "threads.hpp"

namespace nb = nanobind;

using Weights = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Matrix = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Output = nb::ndarray<float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

namespace naosprint {

#define NAOSPRINT_DECLARE(isa)                 \
  namespace isa {                              \
  extern const ForwardKernel forward_kernel;   \
  }
NAOSPRINT_DECLARE(generic)
#ifdef NAOSPRINT_HAS_avx2
NAOSPRINT_DECLARE(avx2)
#endif
#ifdef NAOSPRINT_HAS_avx512
NAOSPRINT_DECLARE(avx512)
#endif

namespace {

const ForwardKernel* const kForwardKernels[] = {
#ifdef NAOSPRINT_HAS_avx512
    &avx512::forward_kernel,
#endif
#ifdef NAOSPRINT_HAS_avx2
    &avx2::forward_kernel,
#endif
    &generic::forward_kernel,
};

void require(bool holds, const char* what) {
  if (!holds) throw nb::value_error(what);
}

class Forward {
 public:
  // Weight and bias of each layer. The arrays are kept, and read by `pack` only.
  Forward(std::vector<std::tuple<Weights, Weights>> arrays, const std::string& name) : arrays_(std::move(arrays)) {
    const Kernel* kernel = name.empty() ? &best_kernel() : find_kernel(name.c_str());
    require(kernel != nullptr, "kernel: not supported by this processor");
    for (const ForwardKernel* each : kForwardKernels)
      if (std::string(each->name) == kernel->name) run_ = each->run;
    require(!arrays_.empty(), "layers: at least one is needed");
    for (const auto& [weight, bias] : arrays_) {
      require(weight.ndim() == 2 && bias.ndim() == 1 && weight.shape(0) == bias.shape(0) && weight.size() > 0, "layers: wrong shape");
      require(layers_.empty() || static_cast<int>(weight.shape(1)) == layers_.back().outputs, "layers: widths do not match");
      const int inputs = static_cast<int>(weight.shape(1)), outputs = static_cast<int>(weight.shape(0));
      const int padded = (outputs + kForwardPad - 1) / kForwardPad * kForwardPad;
      layers_.push_back({inputs, outputs, padded, std::vector<float>(static_cast<std::size_t>(inputs) * padded), std::vector<float>(padded)});
      widest_ = std::max(widest_, padded);
    }
    pack();
  }

  void pack() {
    for (std::size_t l = 0; l < layers_.size(); ++l) {
      const auto& [weight, bias] = arrays_[l];
      PackedLayer& layer = layers_[l];
      for (int r = 0; r < layer.outputs; ++r) {
        for (int k = 0; k < layer.inputs; ++k)
          layer.weight[static_cast<std::size_t>(k) * layer.padded + r] = weight.data()[static_cast<std::size_t>(r) * layer.inputs + k];
        layer.bias[r] = bias.data()[r];
      }
    }
  }

  void run(const Matrix& inputs, const Output& outputs, const std::optional<Matrix>& added, std::uint64_t threads) const {
    const int rows = static_cast<int>(inputs.shape(0)), in = layers_.front().inputs, out = layers_.back().outputs;
    require(static_cast<int>(inputs.shape(1)) == in, "inputs: wrong shape");
    require(static_cast<int>(outputs.shape(0)) == rows && static_cast<int>(outputs.shape(1)) == out, "outputs: wrong shape");
    require(!added || (added->shape(0) == outputs.shape(0) && added->shape(1) == outputs.shape(1)), "added: wrong shape");
    const float *from = inputs.data(), *plus = added ? added->data() : nullptr;
    float* to = outputs.data();
    nb::gil_scoped_release release;
    run_on(threads, (rows + kForwardRows - 1) / kForwardRows, [&](int tile) {
      thread_local std::vector<float> scratch;
      const std::size_t needed = static_cast<std::size_t>(2 * kForwardRows) * widest_;
      if (scratch.size() < needed) scratch.resize(needed);
      const std::size_t first = static_cast<std::size_t>(tile) * kForwardRows;
      run_(layers_, from + first * in, plus == nullptr ? nullptr : plus + first * out, to + first * out,
           std::min(kForwardRows, rows - static_cast<int>(first)), scratch.data());
    });
  }

 private:
  std::vector<std::tuple<Weights, Weights>> arrays_;
  std::vector<PackedLayer> layers_;
  ForwardRows run_ = nullptr;
  int widest_ = 0;
};

}  // namespace

void bind_forward(nb::module_& m) {
  nb::class_<Forward>(m, "Forward")
      .def(nb::init<std::vector<std::tuple<Weights, Weights>>, const std::string&>(), nb::arg("layers"), nb::arg("kernel") = "")
      .def("pack", &Forward::pack)
      .def("run", &Forward::run, nb::arg("inputs"), nb::arg("outputs"), nb::arg("added") = nb::none(), nb::arg("threads") = 0);
}

}  // namespace naosprint
