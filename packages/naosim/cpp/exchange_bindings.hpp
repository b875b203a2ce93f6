// Python bindings that all exchanges have; naosim.fleet documents the arguments.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include "exchange.hpp"

namespace naosim::protocol {

inline int row_of(const Exchange& exchange, int row) {
  if (row < 0 || row >= exchange.size()) throw nanobind::value_error("row: out of range");
  return row;
}

template <class Subclass>
void bind_exchange(nanobind::class_<Subclass>& bound) {
  namespace nb = nanobind;
  using Doubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
  using Mask = std::optional<nb::ndarray<const std::uint8_t, nb::c_contig, nb::device::cpu>>;
  const auto rows_of = [](const Exchange& exchange, const Mask& rows) -> const std::uint8_t* {
    if (!rows) return nullptr;
    if (rows->size() != static_cast<std::size_t>(exchange.size())) throw nb::value_error("rows: one value per server is needed");
    return rows->data();
  };
  bound.def("attach", [](Subclass& self, int row, int agent, int monitor) { self.attach(row_of(self, row), agent, monitor); })
      .def("detach", [](Subclass& self, int row) { self.detach(row_of(self, row)); })
      .def("fail", [](Subclass& self, int row, const std::string& reason) { self.fail(row_of(self, row), reason); })
      .def("failure", [](const Subclass& self, int row) { return self.failure(row_of(self, row)); })
      .def("post",
           [](Subclass& self, int row, bool monitor, const nb::bytes& payload) {
             const std::string_view data{payload.c_str(), payload.size()};
             row_of(self, row);
             nb::gil_scoped_release release;
             self.post(row, monitor, data);
           })
      .def("dispatch",
           [rows_of](Subclass& self, const Doubles& commands, const Mask& rows) {
             const std::size_t width = self.joint_count();
             if (commands.size() != static_cast<std::size_t>(self.size()) * width) throw nb::value_error("commands: wrong shape");
             const std::uint8_t* chosen = rows_of(self, rows);
             const double* data = commands.data();
             nb::gil_scoped_release release;
             self.dispatch(data, width, chosen);
           }, nb::arg("commands"), nb::arg("rows").none())
      .def("gather",
           [rows_of](Subclass& self, const Mask& rows, double timeout_s, bool keeping) {
             const std::uint8_t* chosen = rows_of(self, rows);
             nb::gil_scoped_release release;
             return self.gather(chosen, timeout_s, keeping);
           }, nb::arg("rows").none(), nb::arg("timeout_s"), nb::arg("keeping"))
      .def("admit", [](Subclass& self, int row) { self.admit(row_of(self, row)); })
      .def("neglected", [](const Subclass& self, int row) { return self.neglected(row_of(self, row)); })
      .def("set_silence", [](Subclass& self, double silence_s) { self.set_silence(silence_s); })
      .def("renew", [](Subclass& self) { return self.renew(); }, nb::call_guard<nb::gil_scoped_release>())
      .def("collect",
           [rows_of](Subclass& self, const Mask& rows, int messages, int frames, double timeout_s) {
             const std::uint8_t* chosen = rows_of(self, rows);
             nb::gil_scoped_release release;
             self.collect(chosen, messages, frames, timeout_s);
           }, nb::arg("rows").none(), nb::arg("messages"), nb::arg("frames"), nb::arg("timeout_s"))
      .def("drain", [](Subclass& self, int row, double quiet_s, double timeout_s) {
        row_of(self, row);
        nb::gil_scoped_release release;
        self.drain(row, quiet_s, timeout_s);
      });
}

}  // namespace naosim::protocol
