// Compiled forms of observation blocks, measurements and reward terms; naosprint.tasks.compiled documents them.
//
// Every operation treats each robot alone and computes what the Python form computes, operation by operation, so that the bits are the
// same: these files are compiled without fused multiply-add.
#pragma once
#include <cstddef>
#include <cstdint>
#include <map>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

namespace naosprint {

// One row per robot, the numbers of a row side by side.
template <class Number>
struct Table {
  Number* data = nullptr;
  std::ptrdiff_t stride = 0;
  std::int64_t rows = 0;
  int width = 0;
  Number* operator[](std::int64_t row) const { return data + row * stride; }
};

// Some robots: those of an index, or successive ones.
struct Rows {
  const std::int64_t* index;
  std::int64_t first;
  int count;
  std::int64_t operator[](int k) const { return index == nullptr ? first + k : index[k]; }
};

class Operation {
 public:
  virtual ~Operation() = default;
  // Numbers that `measure` writes.
  virtual int width() const { return 0; }
  // The robots' episodes begin.
  virtual void begin(const Rows&) {}
  // The robots have taken a step.
  virtual void update(const Rows&) {}
  // Write the numbers of each robot from out[row] on.
  virtual void measure(const Rows&, const Table<double>&) const {}
};

// Arguments of an operation by name. `at` of an unknown name raises std::invalid_argument.
class Arguments {
 public:
  std::string operation;
  std::map<std::string, Table<double>> reals;
  std::map<std::string, Table<std::int64_t>> integers;
  std::map<std::string, Table<bool>> flags;
  std::map<std::string, std::vector<double>> numbers;
  std::uint64_t function = 0;

  Table<double> real(const char* name, int width) const { return array(reals, name, width); }
  Table<std::int64_t> integer(const char* name, int width) const { return array(integers, name, width); }
  Table<bool> flag(const char* name, int width) const { return array(flags, name, width); }
  const std::vector<double>& list(const char* name) const { return found(numbers, name); }
  double number(const char* name) const { return list(name).at(0); }

 private:
  template <class Value>
  const Value& found(const std::map<std::string, Value>& among, const char* name) const {
    const auto at = among.find(name);
    if (at == among.end()) throw std::invalid_argument("operation " + operation + ": " + name + " is missing, or has another type");
    return at->second;
  }
  template <class Number>
  Table<Number> array(const std::map<std::string, Table<Number>>& among, const char* name, int width) const {
    const Table<Number>& table = found(among, name);
    if (width > 0 && table.width != width)
      throw std::invalid_argument("operation " + operation + ": " + name + ": " + std::to_string(width) + " numbers per robot are needed");
    return table;
  }
};

// Raises std::invalid_argument if there is no such operation or an argument is missing.
std::unique_ptr<Operation> make_operation(const Arguments& arguments);

// NumPy's sum of a contiguous array.
double pairwise_sum(const double* values, std::int64_t count);

}  // namespace naosprint
