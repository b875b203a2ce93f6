#pragma once
#include <nanobind/nanobind.h>

namespace naosprint {

void bind_forward(nanobind::module_& m);

}  // namespace naosprint
