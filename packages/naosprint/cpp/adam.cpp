// Compiled once per instruction set.
#include "adam.hpp"

#include <cmath>

#ifndef NAOSPRINT_ISA
#define NAOSPRINT_ISA generic
#endif

namespace naosprint::NAOSPRINT_ISA {
namespace {

constexpr double kBeta1 = 0.9, kBeta2 = 0.999;
constexpr std::size_t kSums = 8;   // partial sums of a norm
constexpr std::size_t kWhole = 16;  // numbers of a parameter that are computed together; of the rest, other products are rounded

// The Euclidean norm.
float norm(const float* values, std::size_t size) {
  float sums[kSums] = {};
  const std::size_t whole = size / kSums * kSums;
  for (std::size_t k = 0; k < whole; k += kSums)
    for (std::size_t j = 0; j < kSums; ++j) sums[j] += values[k + j] * values[k + j];
  float sum = sums[0];
  for (std::size_t j = 1; j < kSums; ++j) sum += sums[j];
  for (std::size_t k = whole; k < size; ++k) sum += values[k] * values[k];
  return std::sqrt(sum);
}

void clip(const std::vector<Slot>& slots, float most) {
  std::vector<float> norms;
  for (const Slot& slot : slots) norms.push_back(norm(slot.gradient, slot.size));
  const float factor = 1.0f / (norm(norms.data(), norms.size()) + 1e-6f) * most, held = factor > 1.0f ? 1.0f : factor;
  for (const Slot& slot : slots)
    for (std::size_t k = 0; k < slot.size; ++k) slot.gradient[k] *= held;
}

void step(const std::vector<Slot>& slots, double rate, double epsilon) {
  const float share = static_cast<float>(1.0 - kBeta1), square_share = static_cast<float>(1.0 - kBeta2), beta = static_cast<float>(kBeta2);
  const float least = static_cast<float>(epsilon);
  for (const Slot& slot : slots) {
    *slot.step += 1.0f;
    const double t = static_cast<double>(*slot.step);
    const float size = static_cast<float>(rate / (1.0 - std::pow(kBeta1, t)));
    const float spread = static_cast<float>(std::sqrt(1.0 - std::pow(kBeta2, t)));
    float* __restrict p = slot.parameter;
    float* __restrict m = slot.mean;
    float* __restrict v = slot.square;
    const float* __restrict g = slot.gradient;
    const std::size_t whole = slot.size / kWhole * kWhole;
    for (std::size_t k = 0; k < whole; ++k) {
      m[k] = std::fma(share, g[k] - m[k], m[k]);
      v[k] = std::fma(square_share * g[k], g[k], v[k] * beta);
      p[k] -= size * m[k] / (std::sqrt(v[k]) / spread + least);
    }
    for (std::size_t k = whole; k < slot.size; ++k) {
      m[k] = std::fma(share, g[k] - m[k], m[k]);
      v[k] = std::fma(v[k], beta, square_share * g[k] * g[k]);
      p[k] -= size * m[k] / (std::sqrt(v[k]) / spread + least);
    }
  }
}

}  // namespace

#define NAOSPRINT_TEXT_(text) #text
#define NAOSPRINT_TEXT(text) NAOSPRINT_TEXT_(text)
extern const AdamKernel adam_kernel;
const AdamKernel adam_kernel{NAOSPRINT_TEXT(NAOSPRINT_ISA), clip, step};

}  // namespace naosprint::NAOSPRINT_ISA
