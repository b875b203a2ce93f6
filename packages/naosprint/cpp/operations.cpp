#include "operations.hpp"

#include <algorithm>
#include <cmath>
#include <map>
#include <stdexcept>
#include <type_traits>

namespace naosprint {

double pairwise_sum(const double* values, std::int64_t count) {
  if (count < 8) {
    double sum = -0.0;
    for (std::int64_t k = 0; k < count; ++k) sum += values[k];
    return sum;
  }
  if (count <= 128) {
    double r[8];
    for (int j = 0; j < 8; ++j) r[j] = values[j];
    std::int64_t k = 8;
    for (; k < count - count % 8; k += 8)
      for (int j = 0; j < 8; ++j) r[j] += values[k + j];
    double sum = ((r[0] + r[1]) + (r[2] + r[3])) + ((r[4] + r[5]) + (r[6] + r[7]));
    for (; k < count; ++k) sum += values[k];
    return sum;
  }
  std::int64_t half = count / 2;
  half -= half % 8;
  return pairwise_sum(values, half) + pairwise_sum(values + half, count - half);
}

std::uint64_t hashed(std::uint64_t seed, std::uint64_t first, std::uint64_t second, std::uint64_t third) {
  std::uint64_t key = seed * 0x9E3779B97F4A7C15u + first * 0xD1B54A32D192ED03u + second * 0x8CB92BA72F3D8DD7u + third * 0xAEF17502108EF2D9u;
  key = (key ^ (key >> 30)) * 0xBF58476D1CE4E5B9u;
  key = (key ^ (key >> 27)) * 0x94D049BB133111EBu;
  return key ^ (key >> 31);
}

namespace {

constexpr std::size_t kMostArguments = 64;

using Step = Expression::Step;
using Function = void (*)(const Step&, const double* const*, double*, const Rows&);

// A function of numbers, applied to each; an argument of one number stands for all.
template <auto F>
void unary(const Step& step, const double* const* in, double* out, const Rows& rows) {
  for (int c = 0; c < step.width; ++c)
    for (int k = 0; k < rows.count; ++k) out[c * kLanes + k] = F(in[0][c * kLanes + k]);
}

template <auto F>
void binary(const Step& step, const double* const* in, double* out, const Rows& rows) {
  for (int c = 0; c < step.width; ++c) {
    const double *a = in[0] + (step.repeated[0] ? 0 : c * kLanes), *b = in[1] + (step.repeated[1] ? 0 : c * kLanes);
    for (int k = 0; k < rows.count; ++k) out[c * kLanes + k] = F(a[k], b[k]);
  }
}

void where(const Step& step, const double* const* in, double* out, const Rows& rows) {
  for (int c = 0; c < step.width; ++c) {
    const double* from[3];
    for (int j = 0; j < 3; ++j) from[j] = in[j] + (step.repeated[j] ? 0 : c * kLanes);
    for (int k = 0; k < rows.count; ++k) out[c * kLanes + k] = from[0][k] != 0.0 ? from[1][k] : from[2][k];
  }
}

// The rest with the divisor's sign, as in Python.
double rest_of(double value, double divisor) {
  const double rest = std::fmod(value, divisor);
  if (rest == 0.0) return std::copysign(0.0, divisor);
  return (rest < 0.0) != (divisor < 0.0) ? rest + divisor : rest;
}

// The columns of a robot's row that `constants` name.
void source(const Step& step, const double* const*, double* out, const Rows& rows) {
  std::visit(
      [&](const auto& table) {
        for (int k = 0; k < rows.count; ++k) {
          const auto* from = table[rows[k]];
          for (int c = 0; c < step.width; ++c) out[c * kLanes + k] = static_cast<double>(from[static_cast<int>(step.constants[c])]);
        }
      },
      step.array);
}

void columns(const Step& step, const double* const* in, double* out, const Rows& rows) {
  for (int c = 0; c < step.width; ++c) std::copy_n(in[0] + static_cast<int>(step.constants[c]) * kLanes, rows.count, out + c * kLanes);
}

void stack(const Step& step, const double* const* in, double* out, const Rows& rows) {
  for (std::size_t j = 0; j < step.arguments.size(); ++j)
    for (int c = 0; c < static_cast<int>(step.constants[j]); ++c, out += kLanes) std::copy_n(in[j] + c * kLanes, rows.count, out);
}

void sum(const Step& step, const double* const* in, double* out, const Rows& rows) {
  thread_local std::vector<double> row;
  row.resize(static_cast<std::size_t>(step.columns));
  for (int k = 0; k < rows.count; ++k) {
    for (int c = 0; c < step.columns; ++c) row[static_cast<std::size_t>(c)] = in[0][c * kLanes + k];
    out[k] = pairwise_sum(row.data(), step.columns);
  }
}

// A table's value at a number, as numpy.interp: `constants` are its places, then its values.
void interpolated(const Step& step, const double* const* in, double* out, const Rows& rows) {
  const auto half = static_cast<std::ptrdiff_t>(step.constants.size() / 2);
  const double *at = step.constants.data(), *values = at + half;
  for (int k = 0; k < rows.count; ++k) {
    const double x = in[0][k];
    const std::ptrdiff_t j = std::upper_bound(at, at + half, x) - at - 1;
    if (x != x)
      out[k] = x;
    else if (j < 0)
      out[k] = values[0];
    else if (j == half - 1 || at[j] == x)
      out[k] = values[j];
    else
      out[k] = (values[j + 1] - values[j]) / (at[j + 1] - at[j]) * (x - at[j]) + values[j];
  }
}

// A 3 x 3 matrix times 3 x m numbers, both row by row.
void product(const Step& step, const double* const* in, double* out, const Rows& rows) {
  const int m = step.width / 3;
  for (int i = 0; i < 3; ++i)
    for (int c = 0; c < m; ++c)
      for (int k = 0; k < rows.count; ++k) {
        const double *a = in[0] + 3 * i * kLanes + k, *b = in[1] + c * kLanes + k;
        out[(i * m + c) * kLanes + k] = a[0] * b[0] + a[kLanes] * b[m * kLanes] + a[2 * kLanes] * b[2 * m * kLanes];
      }
}

// Numbers of stream in[0] in its in[1]-th draw, from [0, 1).
void uniform(const Step& step, const double* const* in, double* out, const Rows& rows) {
  const auto seed = static_cast<std::uint64_t>(step.constants[0]);
  for (int c = 0; c < step.width; ++c)
    for (int k = 0; k < rows.count; ++k) {
      const auto stream = static_cast<std::uint64_t>(in[0][k]), draw = static_cast<std::uint64_t>(in[1][k]);
      out[c * kLanes + k] = static_cast<double>(hashed(seed, stream, draw, static_cast<std::uint64_t>(c))) / 18446744073709551616.0;
    }
}

// Centre of mass by the robot's own module; see Kinematics in packages/naosim/cpp/batch.hpp.
void centre_of_mass(const Step& step, const double* const* in, double* out, const Rows& rows) {
  struct Kinematics {
    const void* model;
    void (*centre_of_mass)(const void* model, const double* angles_deg, std::ptrdiff_t stride, const std::int64_t* rows, int count, double* out);
  };
  const auto* kinematics = reinterpret_cast<const Kinematics*>(step.address);
  thread_local std::vector<double> angles;
  angles.resize(static_cast<std::size_t>(step.columns) * kLanes);
  for (int k = 0; k < rows.count; ++k)
    for (int c = 0; c < step.columns; ++c) angles[static_cast<std::size_t>(k * step.columns + c)] = in[0][c * kLanes + k];
  double centres[3 * kLanes];
  kinematics->centre_of_mass(kinematics->model, angles.data(), step.columns, nullptr, rows.count, centres);
  for (int c = 0; c < 3; ++c)
    for (int k = 0; k < rows.count; ++k) out[c * kLanes + k] = centres[3 * k + c];
}

struct Entry {
  Function compute;
  int arguments;  // -1: any number
};

#define UNARY(expression) {unary<+[](double a) -> double { return (expression); }>, 1}
#define BINARY(expression) {binary<+[](double a, double b) -> double { return (expression); }>, 2}

// By the names of NumPy's functions, as far as it has them.
const std::map<std::string, Entry> kFunctions = {
    {"source", {source, 0}},
    {"columns", {columns, 1}},
    {"stack", {stack, -1}},
    {"sum", {sum, 1}},
    {"where", {where, 3}},
    {"uniform", {uniform, 2}},
    {"centre_of_mass", {centre_of_mass, 1}},
    {"interpolated", {interpolated, 1}},
    {"product", {product, 2}},
    {"remainder", {binary<rest_of>, 2}},
    {"sin", UNARY(std::sin(a))},
    {"cos", UNARY(std::cos(a))},
    {"exp", UNARY(std::exp(a))},
    {"log", UNARY(std::log(a))},
    {"sqrt", UNARY(std::sqrt(a))},
    {"absolute", UNARY(std::fabs(a))},
    {"add", BINARY(a + b)},
    {"subtract", BINARY(a - b)},
    {"multiply", BINARY(a* b)},
    {"divide", BINARY(a / b)},
    {"arctan2", BINARY(std::atan2(a, b))},
    {"hypot", BINARY(std::hypot(a, b))},
    {"copysign", BINARY(std::copysign(a, b))},
    {"minimum", BINARY(a < b || a != a ? a : b)},
    {"maximum", BINARY(a > b || a != a ? a : b)},
    {"less", BINARY(a < b ? 1.0 : 0.0)},
    {"greater", BINARY(a > b ? 1.0 : 0.0)},
    {"greater_equal", BINARY(a >= b ? 1.0 : 0.0)},
    {"equal", BINARY(a == b ? 1.0 : 0.0)},
};

#undef UNARY
#undef BINARY

void require(bool holds, const Node& node, const char* what) {
  if (!holds) throw std::invalid_argument("function " + node.function + ": " + what);
}

void check(const Node& node, const std::vector<Node>& nodes) {
  const auto given = [&](std::size_t j) { return nodes[static_cast<std::size_t>(node.arguments[j])].width; };
  if (node.function == "source" || node.function == "columns") {
    const int width = node.function == "columns" ? given(0) : std::visit([](const auto& table) { return table.width; }, node.array);
    require(static_cast<int>(node.constants.size()) == node.width, node, "one column a number is needed");
    for (const double column : node.constants) require(column >= 0 && column < width, node, "column out of range");
  } else if (node.function == "stack") {
    int width = 0;
    require(node.constants.size() == node.arguments.size(), node, "one width an argument is needed");
    for (std::size_t j = 0; j < node.arguments.size(); ++j) {
      require(node.constants[j] == given(j), node, "wrong width");
      width += given(j);
    }
    require(width == node.width && node.arguments.size() <= kMostArguments, node, "wrong width");
  } else if (node.function == "uniform") {
    require(node.constants.size() == 1 && given(0) == 1 && given(1) == 1, node, "a seed, a stream and a draw are needed");
  } else if (node.function == "centre_of_mass") {
    require(node.width == 3 && node.address != 0, node, "the address of a function is needed");
  } else if (node.function == "interpolated") {
    require(node.width == 1 && given(0) == 1 && node.constants.size() >= 4 && node.constants.size() % 2 == 0, node, "a number and a table are needed");
  } else if (node.function == "product") {
    require(given(0) == 9 && given(1) % 3 == 0 && node.width == given(1), node, "a 3 x 3 matrix and 3 x m numbers are needed");
  } else if (node.function == "sum") {
    require(node.width == 1, node, "wrong width");
  } else {
    for (std::size_t j = 0; j < node.arguments.size(); ++j)
      require(given(j) == node.width || given(j) == 1, node, "arguments differ in width");
    if (node.arguments.size() == 1) require(given(0) == node.width, node, "wrong width");
  }
}

// Call work(rows) for at most kLanes of the robots at a time.
template <class Work>
void in_parts(const Rows& rows, Work&& work) {
  for (int from = 0; from < rows.count; from += kLanes)
    work(Rows{rows.index == nullptr ? nullptr : rows.index + from, rows.first + from, std::min(kLanes, rows.count - from)});
}

void store(const Expression& expression, const AnyTable& target, const Rows& rows) {
  const double* values = expression.compute(rows);
  const bool repeated = expression.width() == 1;
  std::visit(
      [&](const auto& table) {
        for (int k = 0; k < rows.count; ++k)
          for (int c = 0; c < table.width; ++c) {
            auto& number = table[rows[k]][c];
            number = static_cast<std::remove_reference_t<decltype(number)>>(values[(repeated ? 0 : c) * kLanes + k]);
          }
      },
      target);
}

}  // namespace

Expression::Expression(const std::vector<Node>& nodes) {
  std::vector<int> places;  // of each node
  for (const Node& node : nodes) {
    require(node.width > 0, node, "wrong width");
    for (const int argument : node.arguments) require(argument >= 0 && argument < static_cast<int>(places.size()), node, "no such argument");
    if (node.function == "constant") {
      require(static_cast<int>(node.constants.size()) == node.width, node, "one value a number is needed");
      places.push_back(-1 - static_cast<int>(constants_.size()));
      for (const double value : node.constants) constants_.insert(constants_.end(), kLanes, value);
      continue;
    }
    const auto at = kFunctions.find(node.function);
    if (at == kFunctions.end()) throw std::invalid_argument("function " + node.function + ": there is none of this name");
    require(at->second.arguments < 0 || at->second.arguments == static_cast<int>(node.arguments.size()), node, "wrong number of arguments");
    check(node, nodes);
    Step step{at->second.compute, {}, {}, node.width, size_, 0, node.constants, node.array, node.address};
    for (const int argument : node.arguments) {
      step.arguments.push_back(places[static_cast<std::size_t>(argument)]);
      step.repeated.push_back(nodes[static_cast<std::size_t>(argument)].width == 1);
    }
    if (!node.arguments.empty()) step.columns = nodes[static_cast<std::size_t>(node.arguments[0])].width;
    places.push_back(size_);
    size_ += node.width * kLanes;
    steps_.push_back(std::move(step));
  }
  if (nodes.empty()) throw std::invalid_argument("expression: it is empty");
  result_ = places.back();
  width_ = nodes.back().width;
}

const double* Expression::compute(const Rows& rows) const {
  thread_local std::vector<double> numbers;
  if (static_cast<int>(numbers.size()) < size_) numbers.resize(static_cast<std::size_t>(size_));
  const auto at = [&](int place) { return place < 0 ? constants_.data() + (-1 - place) : numbers.data() + place; };
  const double* arguments[kMostArguments];
  for (const Step& step : steps_) {
    for (std::size_t j = 0; j < step.arguments.size(); ++j) arguments[j] = at(step.arguments[j]);
    step.function(step, arguments, numbers.data() + step.place, rows);
  }
  return at(result_);
}

void Operation::begin(const Rows& all) const {
  in_parts(all, [&](const Rows& rows) {
    for (const Store& each : stores)
      for (const Expression& expression : each.begin) store(expression, each.target, rows);
  });
}

void Operation::update(const Rows& all) const {
  in_parts(all, [&](const Rows& rows) {
    for (const Store& each : stores)
      for (const Expression& expression : each.update) store(expression, each.target, rows);
  });
}

void Operation::measure(const Rows& all, const Table<double>& out) const {
  in_parts(all, [&](const Rows& rows) {
    for (const Expression& expression : value) {
      const double* values = expression.compute(rows);
      for (int k = 0; k < rows.count; ++k)
        for (int c = 0; c < expression.width(); ++c) out[rows[k]][c] = values[c * kLanes + k];
    }
  });
}

}  // namespace naosprint
