// The class Adam of naosprint.rl._kernel; naosprint.rl.adam documents it.
#include "adam_bindings.hpp"

#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <string>
#include <tuple>
#include <vector>

#include "adam.hpp"
#include "network.hpp"

namespace nb = nanobind;

using Numbers = nb::ndarray<float, nb::c_contig, nb::device::cpu>;

namespace naosprint {

#define NAOSPRINT_DECLARE(isa)             \
  namespace isa {                          \
  extern const AdamKernel adam_kernel;     \
  }
NAOSPRINT_DECLARE(generic)
#ifdef NAOSPRINT_HAS_avx2
NAOSPRINT_DECLARE(avx2)
#endif
#ifdef NAOSPRINT_HAS_avx512
NAOSPRINT_DECLARE(avx512)
#endif

namespace {

const AdamKernel* const kAdamKernels[] = {
#ifdef NAOSPRINT_HAS_avx512
    &avx512::adam_kernel,
#endif
#ifdef NAOSPRINT_HAS_avx2
    &avx2::adam_kernel,
#endif
    &generic::adam_kernel,
};

void require(bool holds, const char* what) {
  if (!holds) throw nb::value_error(what);
}

// Pointers to parameters, their gradients and what is remembered of these. The arrays are kept.
class Adam {
 public:
  Adam(std::vector<std::tuple<Numbers, Numbers, Numbers, Numbers, Numbers>> arrays, const std::string& name) : arrays_(std::move(arrays)) {
    const Kernel* kernel = name.empty() ? &best_kernel() : find_kernel(name.c_str());
    require(kernel != nullptr, "kernel: not supported by this processor");
    for (const AdamKernel* each : kAdamKernels)
      if (std::string(each->name) == kernel->name) kernel_ = each;
    for (auto& [parameter, gradient, mean, square, step] : arrays_) {
      const std::size_t size = parameter.size();
      require(gradient.size() == size && mean.size() == size && square.size() == size && step.size() == 1, "arrays: sizes do not match");
      slots_.push_back({parameter.data(), gradient.data(), mean.data(), square.data(), step.data(), size});
    }
  }

  void clip(float most) const { kernel_->clip(slots_, most); }
  void step(double rate, double epsilon) const { kernel_->step(slots_, rate, epsilon); }

 private:
  std::vector<std::tuple<Numbers, Numbers, Numbers, Numbers, Numbers>> arrays_;
  std::vector<Slot> slots_;
  const AdamKernel* kernel_ = nullptr;
};

}  // namespace

void bind_adam(nb::module_& m) {
  nb::class_<Adam>(m, "Adam")
      .def(nb::init<std::vector<std::tuple<Numbers, Numbers, Numbers, Numbers, Numbers>>, const std::string&>(), nb::arg("arrays"),
           nb::arg("kernel") = "")
      .def("clip", &Adam::clip, nb::arg("most"))
      .def("step", &Adam::step, nb::arg("rate"), nb::arg("epsilon"));
}

}  // namespace naosprint
