// Interpreter of expressions, which describe observations, measurements and reward terms; naosprint.terms documents them.
//
// Every function treats each robot alone and computes what NumPy computes in naosprint.terms.expressions, operation by operation, so that
// the bits are the same: this file is compiled without fused multiply-add.
#pragma once
#include <cstddef>
#include <cstdint>
#include <string>
#include <variant>
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
using AnyTable = std::variant<Table<double>, Table<std::int64_t>, Table<bool>>;

// Some robots: those of an index, or successive ones.
struct Rows {
  const std::int64_t* index;
  std::int64_t first;
  int count;
  std::int64_t operator[](int k) const { return index == nullptr ? first + k : index[k]; }
};

// One 64-bit hash of three keys (the finalizer of splitmix64), as naosprint.terms.randomness.hashed.
std::uint64_t hashed(std::uint64_t seed, std::uint64_t first, std::uint64_t second, std::uint64_t third);

// NumPy's sum of a contiguous array.
double pairwise_sum(const double* values, std::int64_t count);

// One function of an expression: what it is computed from, by index of earlier nodes.
struct Node {
  std::string function;
  std::vector<int> arguments;
  int width;
  std::vector<double> constants;
  AnyTable array;              // of a source
  std::uint64_t address = 0;  // of a function of another module
};

constexpr int kLanes = 16;  // robots that are computed side by side

// An expression, computed node after node: the last one is its value.
class Expression {
 public:
  // Raises std::invalid_argument if there is no such function, or an argument does not fit.
  explicit Expression(const std::vector<Node>& nodes);
  int width() const { return width_; }
  // Return `width()` times kLanes numbers: each number of up to kLanes robots side by side.
  const double* compute(const Rows& rows) const;

  struct Step {
    void (*function)(const Step& step, const double* const* arguments, double* out, const Rows& rows);
    std::vector<int> arguments;     // places of numbers: from 0 on those computed, from -1 down constants
    std::vector<int> repeated;      // for each argument, whether its one number stands for all
    int width, place, columns;      // columns: numbers of the first argument
    std::vector<double> constants;
    AnyTable array;
    std::uint64_t address;
  };

 private:
  std::vector<Step> steps_;
  std::vector<double> constants_;
  int width_ = 0, size_ = 0, result_ = 0;
};

// What a part of a task stores and computes: stores, one after the other, and a value.
class Operation {
 public:
  struct Store {
    AnyTable target;
    std::vector<Expression> begin, update;  // one or none
  };
  std::vector<Store> stores;
  std::vector<Expression> value;  // one or none

  // Numbers that `measure` writes.
  int width() const { return value.empty() ? 0 : value.front().width(); }
  // The robots' episodes begin.
  void begin(const Rows& rows) const;
  // The robots have taken a step.
  void update(const Rows& rows) const;
  // Write the numbers of each robot from out[row] on.
  void measure(const Rows& rows, const Table<double>& out) const;
};

}  // namespace naosprint
