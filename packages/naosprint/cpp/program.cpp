#include "program.hpp"

#include <algorithm>
#include <cmath>

#include "threads.hpp"

namespace naosprint {
namespace {

constexpr int kRows = 16;  // robots that one thread takes at a time
constexpr double kPi = 3.14159265358979323846;

// Return an angle in [-pi, pi), as Python's (angle + pi) % (2 pi) - pi.
double wrapped(double angle) {
  const double turn = 2.0 * kPi;
  double rest = std::fmod(angle + kPi, turn);
  if (rest == 0.0)
    rest = 0.0;
  else if (rest < 0.0)
    rest += turn;
  return rest - kPi;
}

}  // namespace

void Program::step(std::int64_t first, int count, const bool* lost, const Limits& limits, std::uint64_t threads) const {
  run_on(threads, (count + kRows - 1) / kRows, [&](int part) {
    const int from = part * kRows;
    step_rows({nullptr, first + from, std::min(kRows, count - from)}, lost == nullptr ? nullptr : lost + from, limits);
  });
}

void Program::step_rows(const Rows& rows, const bool* lost, const Limits& limits) const {
  const Arrays& a = arrays;
  for (int k = 0; k < rows.count; ++k) ++*a.steps[rows[k]];
  for (const auto& measurement : measurements) measurement->update(rows);
  for (const Block& block : blocks) block.operation->update(rows);
  const int past = seen - width;
  for (int k = 0; past > 0 && k < rows.count; ++k) {
    double* row = a.observations[rows[k]];
    std::copy_backward(row, row + past, row + past + width);
  }
  for (const Block& block : blocks) {
    const int width = block.operation->width();
    Table<double> columns = a.observations;
    columns.data += block.first;
    block.operation->measure(rows, columns);
    if (!block.rates) continue;
    for (int k = 0; k < rows.count; ++k) {
      double *now = columns[rows[k]], *before = a.values[rows[k]] + block.value;
      for (int c = 0; c < width; ++c) {
        const double rate = now[c] - before[c];
        now[width + c] = block.angular ? wrapped(rate) : rate;
        before[c] = now[c];
      }
    }
  }
  double value[kRows], sum[kRows] = {};
  // operations write to the row of a robot, counted from the first
  const Table<double> values{value - rows[0], 1, 0, 1};
  for (std::size_t number = 0; number < terms.size(); ++number) {
    const Term& term = terms[number];
    term.operation->measure(rows, values);
    for (int k = 0; k < rows.count; ++k) {
      const double weighted = term.weight == 1.0 ? value[k] : term.weight * value[k];
      sum[k] = number == 0 ? weighted : sum[k] + weighted;
    }
  }
  for (int k = 0; k < rows.count; ++k) {
    const std::int64_t row = rows[k];
    const bool gone = lost != nullptr && lost[k];
    bool over = false, failed = false;
    for (const End& end : ends) {
      const bool reached = *end.flag[row] && !gone;
      *end.reached[row] = reached;
      over = over || reached;
      failed = failed || (reached && end.failure);
    }
    const bool late = *a.steps[row] >= limits.max_steps;
    const bool terminated = limits.horizon_is_terminal ? (over || late) && !gone : over;
    const bool truncated = limits.horizon_is_terminal ? gone : (late && !over) || gone;
    const bool cut = *a.short_episode[row] && *a.steps[row] >= limits.short_steps && !terminated;
    *a.rewards[row] = gone ? 0.0 : sum[k] * scale;
    *a.lost[row] = gone;
    *a.failed[row] = failed;
    *a.terminated[row] = terminated;
    *a.truncated[row] = truncated || cut;
  }
}

void Program::begin(const Rows& rows) const {
  const Arrays& a = arrays;
  for (int k = 0; k < rows.count; ++k) {
    const std::int64_t row = rows[k];
    *a.steps[row] = 0;
    std::fill_n(a.actions[row], a.actions.width, 0.0);
    std::fill_n(a.previous_actions[row], a.previous_actions.width, 0.0);
    *a.failed[row] = false;
    for (const End& end : ends) *end.reached[row] = false;
  }
  for (const auto& measurement : measurements) measurement->begin(rows);
  for (const Block& block : blocks) block.operation->begin(rows);
  for (const Block& block : blocks) {
    const int width = block.operation->width();
    Table<double> columns = a.observations;
    columns.data += block.first;
    block.operation->measure(rows, columns);
    if (!block.rates) continue;
    for (int k = 0; k < rows.count; ++k) {
      double* now = columns[rows[k]];
      std::copy_n(now, width, a.values[rows[k]] + block.value);
      std::fill_n(now + width, width, 0.0);
    }
  }
  // before its episode a robot has seen what it sees at the start
  for (int k = 0; k < rows.count; ++k) {
    double* row = a.observations[rows[k]];
    for (int past = width; past < seen; past += width) std::copy_n(row, width, row + past);
  }
}

}  // namespace naosprint
