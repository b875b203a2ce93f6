// Compiled once per instruction set.
#include "forward.hpp"

#include <cstddef>

#ifndef NAOSPRINT_ISA
#define NAOSPRINT_ISA generic
#endif

namespace naosprint::NAOSPRINT_ISA {
namespace {

#if defined(__AVX512F__)
constexpr int kWidth = 16, kBlockRows = 8;
#elif defined(__AVX2__)
constexpr int kWidth = 8, kBlockRows = 4;
#else
constexpr int kWidth = 4, kBlockRows = 2;
#endif
typedef float Vector __attribute__((vector_size(4 * kWidth)));
typedef float Unaligned __attribute__((vector_size(4 * kWidth), aligned(4)));

inline Vector load(const float* from) { return *reinterpret_cast<const Unaligned*>(from); }
inline void store(float* to, Vector value) { *reinterpret_cast<Unaligned*>(to) = value; }
inline Vector splat(float value) { return value - Vector{}; }  // the sum of 0 and -0 is 0, so adding would take an addition

// tanh to a few units in the last place: rational minimax approximation, as in Eigen. NaN stays NaN.
inline Vector tanh(Vector x) {
  const Vector limit = splat(7.90531110763549805f);
  x = x > limit ? limit : x;
  x = x < -limit ? -limit : x;
  const Vector z = x * x;
  Vector p = splat(-2.76076847742355e-16f);
  p = z * p + 2.00018790482477e-13f;
  p = z * p + -8.60467152213735e-11f;
  p = z * p + 5.12229709037114e-08f;
  p = z * p + 1.48572235717979e-05f;
  p = z * p + 6.37261928875436e-04f;
  p = z * p + 4.89352455891786e-03f;
  Vector q = splat(1.19825839466702e-06f);
  q = z * q + 1.18534705686654e-04f;
  q = z * q + 2.26843463243900e-03f;
  q = z * q + 4.89352518554385e-03f;
  return x * p / q;
}

// kRows rows, and two vectors of outputs at once.
template <int kRows, int kVectors>
inline void block(const PackedLayer& layer, const float* inputs, std::ptrdiff_t stride, bool squash, int first, float* outputs,
                  std::ptrdiff_t output_stride) {
  Vector sum[kRows][kVectors];
  for (int v = 0; v < kVectors; ++v) {
    const Vector bias = load(layer.bias.data() + first + v * kWidth);
    for (int r = 0; r < kRows; ++r) sum[r][v] = bias;
  }
  const float* column = layer.weight.data() + first;
  for (int k = 0; k < layer.inputs; ++k, column += layer.padded) {
    Vector weight[kVectors];
    for (int v = 0; v < kVectors; ++v) weight[v] = load(column + v * kWidth);
    for (int r = 0; r < kRows; ++r) {
      const Vector factor = splat(inputs[r * stride + k]);
      for (int v = 0; v < kVectors; ++v) sum[r][v] = sum[r][v] + factor * weight[v];
    }
  }
  for (int r = 0; r < kRows; ++r)
    for (int v = 0; v < kVectors; ++v) store(outputs + r * output_stride + first + v * kWidth, squash ? tanh(sum[r][v]) : sum[r][v]);
}

template <int kRows>
void rows_of(const PackedLayer& layer, const float* inputs, std::ptrdiff_t stride, bool squash, float* outputs) {
  int first = 0;
  for (; first + 2 * kWidth <= layer.padded; first += 2 * kWidth) block<kRows, 2>(layer, inputs, stride, squash, first, outputs, layer.padded);
  for (; first < layer.padded; first += kWidth) block<kRows, 1>(layer, inputs, stride, squash, first, outputs, layer.padded);
}

void run(const std::vector<PackedLayer>& layers, const float* inputs, const float* added, float* outputs, int rows, float* scratch) {
  int widest = 0;
  for (const PackedLayer& layer : layers) widest = layer.padded > widest ? layer.padded : widest;
  float* halves[2] = {scratch, scratch + static_cast<std::size_t>(kForwardRows) * widest};
  const float* from = inputs;
  std::ptrdiff_t stride = layers.front().inputs;
  for (std::size_t l = 0; l < layers.size(); ++l) {
    const PackedLayer& layer = layers[l];
    float* to = halves[l % 2];
    const bool squash = l + 1 < layers.size();
    int r = 0;
    for (; r + kBlockRows <= rows; r += kBlockRows) rows_of<kBlockRows>(layer, from + r * stride, stride, squash, to + r * layer.padded);
    for (; r < rows; ++r) rows_of<1>(layer, from + r * stride, stride, squash, to + r * layer.padded);
    from = to;
    stride = layer.padded;
  }
  const int width = layers.back().outputs;
  for (int r = 0; r < rows; ++r)
    for (int j = 0; j < width; ++j) outputs[r * width + j] = added == nullptr ? from[r * stride + j] : from[r * stride + j] + added[r * width + j];
}

}  // namespace

#define NAOSPRINT_TEXT_(text) #text
#define NAOSPRINT_TEXT(text) NAOSPRINT_TEXT_(text)
extern const ForwardKernel forward_kernel;
const ForwardKernel forward_kernel{NAOSPRINT_TEXT(NAOSPRINT_ISA), run};

}  // namespace naosprint::NAOSPRINT_ISA
