#include "normalization.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>

#include "operations.hpp"
#include "threads.hpp"

// Compiled for wider registers, too, which changes no bit: nothing is fused, and every sum has its order.
#if defined(__x86_64__) && defined(__GLIBC__) && !defined(__SANITIZE_ADDRESS__)
#define NAOSPRINT_WIDE __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define NAOSPRINT_WIDE
#endif

namespace naosprint {
namespace {

constexpr double kEpsilon = 1e-8;
constexpr int kColumns = 32;        // columns whose sums are computed together
constexpr std::int64_t kRows = 16;  // rows that are standardized together

// Means of up to kColumns columns, and sums of the squared differences from them, row after row.
NAOSPRINT_WIDE void column_sums(const double* samples, std::int64_t rows, std::int64_t stride, int columns, double* mean, double* squares) {
  double sum[kColumns] = {}, square[kColumns] = {};
  for (std::int64_t r = 0; r < rows; ++r)
    for (int c = 0; c < columns; ++c) sum[c] += samples[r * stride + c];
  for (int c = 0; c < columns; ++c) sum[c] /= static_cast<double>(rows);
  for (std::int64_t r = 0; r < rows; ++r)
    for (int c = 0; c < columns; ++c) {
      const double off = samples[r * stride + c] - sum[c];
      square[c] += off * off;
    }
  for (int c = 0; c < columns; ++c) {
    mean[c] = sum[c];
    squares[c] = square[c];
  }
}

// Returns whether the results are finite.
NAOSPRINT_WIDE bool standardize_rows(const double* samples, const double* mean, const double* spread, std::int64_t rows, int width, double clip,
                                     float* out) {
  std::uint32_t largest = 0;
  for (std::int64_t r = 0; r < rows; ++r) {
    for (int c = 0; c < width; ++c) {
      double value = (samples[r * width + c] - mean[c]) / spread[c];
      value = value < -clip ? -clip : value;
      value = value > clip ? clip : value;
      out[r * width + c] = static_cast<float>(value);
    }
    for (int c = 0; c < width; ++c) {
      std::uint32_t bits;
      std::memcpy(&bits, out + r * width + c, sizeof bits);
      largest = std::max(largest, bits & 0x7FFFFFFFu);
    }
  }
  return largest < 0x7F800000u;
}

void merge_moments(const Moments& moments, const double* mean, const double* squares, double k) {
  for (int j = 0; j < moments.width; ++j) {
    const double count = moments.count[j], total = count + k;
    const double delta = mean[j] - moments.mean[j];
    moments.mean[j] = moments.mean[j] + delta * (k / total);
    moments.variance[j] = (moments.variance[j] * count + squares[j] + delta * delta * (count * k / total)) / total;
    moments.count[j] = total;
  }
}

// numpy.einsum("ij,ij->j", values, values) of one column: two sums, four times two values at a time, from the last to the first.
double sum_of_squares(const double* values, std::int64_t count) {
  double even = 0.0, odd = 0.0;
  std::int64_t k = 0;
  for (; count - k >= 8; k += 8)
    for (int j = 6; j >= 0; j -= 2) {
      even = values[k + j] * values[k + j] + even;
      odd = values[k + j + 1] * values[k + j + 1] + odd;
    }
  for (; k < count; k += 2) {
    even = values[k] * values[k] + even;
    if (k + 1 < count) odd = values[k + 1] * values[k + 1] + odd;
  }
  return even + odd;
}

}  // namespace

void merge(const Moments& moments, const MirrorImage& mirror, const double* samples, std::int64_t rows, std::uint64_t threads) {
  const int width = moments.width;
  const std::size_t size = static_cast<std::size_t>(width);
  std::vector<double> mean(size), squares(size);
  run_on(threads, (width + kColumns - 1) / kColumns, [&](int part) {
    const int first = part * kColumns;
    column_sums(samples + first, rows, width, std::min(kColumns, width - first), &mean[first], &squares[first]);
  });
  const double k = static_cast<double>(rows);
  if (mirror.index != nullptr) {
    std::vector<double> half_gap(size), both(size), middle(size);
    for (std::size_t j = 0; j < size; ++j) {
      const double image = mean[mirror.index[j]] * mirror.sign[j];
      half_gap[j] = 0.5 * (mean[j] - image);
      both[j] = 0.5 * (squares[j] + squares[mirror.index[j]]) + k * half_gap[j] * half_gap[j];
      middle[j] = 0.5 * (mean[j] + image);
    }
    mean.swap(middle);
    squares.swap(both);
  }
  merge_moments(moments, mean.data(), squares.data(), k);
}

bool standardize(const Moments& moments, const double* samples, std::int64_t rows, double clip, float* out, std::uint64_t threads) {
  const int width = moments.width;
  std::vector<double> spread(static_cast<std::size_t>(width));
  for (int j = 0; j < width; ++j) spread[j] = std::sqrt(moments.variance[j] + kEpsilon);
  std::atomic<bool> finite{true};
  run_on(threads, static_cast<int>((rows + kRows - 1) / kRows), [&](int part) {
    const std::int64_t first = part * kRows;
    const std::int64_t count = std::min(kRows, rows - first);
    if (!standardize_rows(samples + first * width, moments.mean, spread.data(), count, width, clip, out + first * width)) finite = false;
  });
  return finite;
}

void scale_rewards(const Moments& moments, double* returns, const double* rewards, const bool* dones, std::int64_t rows, double gamma, double clip,
                   float* out) {
  for (std::int64_t r = 0; r < rows; ++r) returns[r] = returns[r] * gamma + rewards[r];
  const double mean = pairwise_sum(returns, rows) / static_cast<double>(rows);
  std::vector<double> centred(static_cast<std::size_t>(rows));
  for (std::int64_t r = 0; r < rows; ++r) centred[r] = returns[r] - mean;
  const double squares = sum_of_squares(centred.data(), rows);
  merge_moments(moments, &mean, &squares, static_cast<double>(rows));
  const double spread = std::sqrt(moments.variance[0] + kEpsilon);
  for (std::int64_t r = 0; r < rows; ++r) {
    const double scaled = rewards[r] / spread;
    out[r] = static_cast<float>(scaled < -clip ? -clip : scaled > clip ? clip : scaled);
    if (dones[r]) returns[r] = 0.0;
  }
}

}  // namespace naosprint
