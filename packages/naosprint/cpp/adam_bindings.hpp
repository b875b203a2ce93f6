#pragma once
#include <nanobind/nanobind.h>

namespace naosprint {

void bind_adam(nanobind::module_& m);

}  // namespace naosprint
