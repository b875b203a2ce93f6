// Compiled once per instruction set.
#include <cmath>
#include <cstddef>
#include <cstring>

#include "network.hpp"

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
constexpr int kTile = 64;      // rows that pass through the network together
constexpr int kPad = 16;       // columns are padded to a multiple, for every instruction set alike
typedef float Vector __attribute__((vector_size(4 * kWidth)));
typedef float Unaligned __attribute__((vector_size(4 * kWidth), aligned(4)));
typedef std::int32_t Whole __attribute__((vector_size(4 * kWidth)));

inline Vector load(const float* from) { return *reinterpret_cast<const Unaligned*>(from); }
inline void store(float* to, Vector value) { *reinterpret_cast<Unaligned*>(to) = value; }
inline Vector splat(float value) { return Vector{} + value; }
constexpr int padded(int columns) { return (columns + kPad - 1) / kPad * kPad; }

// C[r, v] (+)= sum over k of A[r, k] B[k, v] for kBlockRows rows and kVectors vectors of columns.
template <int kRows, int kVectors, bool kAdd>
inline void block(int depth, const float* a, std::ptrdiff_t a_row, std::ptrdiff_t a_depth, const float* b, std::ptrdiff_t b_depth, float* c,
                  std::ptrdiff_t c_row) {
  Vector sum[kRows][kVectors];
  for (int r = 0; r < kRows; ++r)
    for (int v = 0; v < kVectors; ++v) sum[r][v] = kAdd ? load(c + r * c_row + v * kWidth) : Vector{};
  for (int k = 0; k < depth; ++k) {
    Vector column[kVectors];
    for (int v = 0; v < kVectors; ++v) column[v] = load(b + k * b_depth + v * kWidth);
    for (int r = 0; r < kRows; ++r) {
      const Vector factor = splat(a[r * a_row + k * a_depth]);
      for (int v = 0; v < kVectors; ++v) sum[r][v] += factor * column[v];  // contracted to a fused multiply-add
    }
  }
  for (int r = 0; r < kRows; ++r)
    for (int v = 0; v < kVectors; ++v) store(c + r * c_row + v * kWidth, sum[r][v]);
}

// C (rows, columns) (+)= A B; columns is a multiple of kPad, rows of kBlockRows.
template <bool kAdd>
void multiply(int rows, int columns, int depth, const float* a, std::ptrdiff_t a_row, std::ptrdiff_t a_depth, const float* b, std::ptrdiff_t b_depth,
              float* c, std::ptrdiff_t c_row) {
  constexpr int kWide = 2 * kWidth;
  for (int v = 0; v < columns;) {
    const bool wide = columns - v >= kWide;
    for (int r = 0; r < rows; r += kBlockRows) {
      if (wide)
        block<kBlockRows, 2, kAdd>(depth, a + r * a_row, a_row, a_depth, b + v, b_depth, c + r * c_row + v, c_row);
      else
        block<kBlockRows, 1, kAdd>(depth, a + r * a_row, a_row, a_depth, b + v, b_depth, c + r * c_row + v, c_row);
    }
    v += wide ? kWide : kWidth;
  }
}

// tanh to 2 units in the last place: rational minimax approximation, as in Eigen.
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

// A network with room for the activations of one tile, and weights in the layout of the products.
struct Net {
  const std::vector<Layer>& layers;
  std::vector<int> in, out;           // padded widths
  std::vector<float*> forward;        // (inputs, padded outputs): transposed weights
  std::vector<float*> backward;       // (outputs, padded inputs)
  std::vector<float*> bias;           // (padded outputs)
  std::vector<float*> gradient;       // (padded outputs, padded inputs)
  std::vector<float*> bias_gradient;  // (padded outputs)
  std::vector<float*> values;         // (kTile, padded width): inputs, then the outputs of each layer
  std::vector<float*> errors;         // (kTile, padded outputs): derivatives by a layer's outputs before tanh

  Net(const std::vector<Layer>& given, Workspace& workspace) : layers(given) {
    std::size_t floats = 0;
    for (const Layer& layer : layers) {
      in.push_back(padded(layer.inputs));
      out.push_back(padded(layer.outputs));
      const std::size_t i = static_cast<std::size_t>(in.back()), o = static_cast<std::size_t>(out.back());
      floats += 3 * i * o + 2 * o + kTile * (i + 2 * o) + 16 * 16;
    }
    workspace.reserve(floats);
    workspace.begin();
    const auto zeros = [&](std::size_t count) {
      float* at = workspace.take(count);
      std::memset(at, 0, sizeof(float) * count);
      return at;
    };
    values.push_back(zeros(static_cast<std::size_t>(kTile) * in[0]));
    for (std::size_t l = 0; l < layers.size(); ++l) {
      const Layer& layer = layers[l];
      const std::size_t i = static_cast<std::size_t>(in[l]), o = static_cast<std::size_t>(out[l]);
      forward.push_back(zeros(i * o));
      backward.push_back(zeros(i * o));
      gradient.push_back(zeros(i * o));
      bias.push_back(zeros(o));
      bias_gradient.push_back(zeros(o));
      values.push_back(zeros(kTile * o));
      errors.push_back(zeros(kTile * o));
      for (int r = 0; r < layer.outputs; ++r) {
        for (int k = 0; k < layer.inputs; ++k) {
          const float weight = layer.weight[static_cast<std::size_t>(r) * layer.inputs + k];
          forward[l][k * o + r] = weight;
          backward[l][r * i + k] = weight;
        }
        bias[l][r] = layer.bias[r];
      }
    }
  }

  // Load the observations of up to kTile rows; further rows are zero.
  void gather(const float* observations, const std::int64_t* index, int count) {
    const int width = layers[0].inputs;
    for (int r = 0; r < count; ++r)
      std::memcpy(values[0] + static_cast<std::size_t>(r) * in[0], observations + index[r] * width, sizeof(float) * width);
    for (int r = count; r < kTile; ++r) std::memset(values[0] + static_cast<std::size_t>(r) * in[0], 0, sizeof(float) * in[0]);
  }

  // Compute the outputs, which are the last of `values`.
  void run() {
    for (std::size_t l = 0; l < layers.size(); ++l) {
      float* outputs = values[l + 1];
      multiply<false>(kTile, out[l], layers[l].inputs, values[l], in[l], 1, forward[l], out[l], outputs, out[l]);
      const bool squash = l + 1 < layers.size();
      for (int r = 0; r < kTile; ++r)
        for (int v = 0; v < out[l]; v += kWidth) {
          float* at = outputs + static_cast<std::size_t>(r) * out[l] + v;
          const Vector sum = load(at) + load(bias[l] + v);
          store(at, squash ? tanh(sum) : sum);
        }
    }
  }

  // Add the tile's gradient, given the derivatives by the outputs in the last of `errors`, zero for rows that do not count.
  void learn() {
    for (std::size_t l = layers.size(); l-- > 0;) {
      const float *error = errors[l], *inputs = values[l];
      multiply<true>(out[l], in[l], kTile, error, 1, out[l], inputs, in[l], gradient[l], in[l]);
      for (int v = 0; v < out[l]; v += kWidth) {
        Vector sum = load(bias_gradient[l] + v);
        for (int r = 0; r < kTile; ++r) sum += load(error + static_cast<std::size_t>(r) * out[l] + v);
        store(bias_gradient[l] + v, sum);
      }
      if (l == 0) break;
      float* below = errors[l - 1];
      multiply<false>(kTile, in[l], layers[l].outputs, error, out[l], 1, backward[l], in[l], below, in[l]);
      for (std::size_t at = 0; at < static_cast<std::size_t>(kTile) * in[l]; at += kWidth) {
        const Vector squashed = load(inputs + at);
        store(below + at, load(below + at) * (1.0f - squashed * squashed));
      }
    }
  }

  // Add the gradient of all rows. `differentiate(sample, outputs, errors)` fills in the derivatives by one sample's outputs.
  template <class Differentiate>
  void pass(const float* observations, const Rows& rows, Differentiate differentiate) {
    const std::size_t width = static_cast<std::size_t>(out.back());
    for (int first = 0; first < rows.count; first += kTile) {
      const int count = rows.count - first < kTile ? rows.count - first : kTile;
      const std::int64_t* index = rows.index + first;
      gather(observations, index, count);
      run();
      std::memset(errors.back(), 0, sizeof(float) * kTile * width);
      for (int r = 0; r < count; ++r) differentiate(index[r], values.back() + r * width, errors.back() + r * width);
      learn();
    }
  }

  void write_gradient() const {
    for (std::size_t l = 0; l < layers.size(); ++l)
      for (int r = 0; r < layers[l].outputs; ++r) {
        const std::size_t width = static_cast<std::size_t>(layers[l].inputs);
        std::memcpy(layers[l].weight_gradient + r * width, gradient[l] + static_cast<std::size_t>(r) * in[l], sizeof(float) * width);
        layers[l].bias_gradient[r] = bias_gradient[l][r];
      }
  }
};

ActorResult actor(const std::vector<Layer>& layers, const float* log_std, float* log_std_gradient, const Rollout& rollout, const Rows& rows,
                  bool normalize_advantages, float clip_range, Workspace& workspace) {
  Net net(layers, workspace);
  const int actions = layers.back().outputs;
  float mean = 0.0f, factor = 1.0f;
  if (normalize_advantages) {
    double sum = 0.0, squares = 0.0;
    for (int r = 0; r < rows.count; ++r) sum += static_cast<double>(rollout.advantages[rows.index[r]]);
    const double middle = sum / rows.count;
    for (int r = 0; r < rows.count; ++r) {
      const double off = static_cast<double>(rollout.advantages[rows.index[r]]) - middle;
      squares += off * off;
    }
    mean = static_cast<float>(middle);
    factor = static_cast<float>(1.0 / (std::sqrt(squares / (rows.count - 1)) + 1e-8));
  }
  std::vector<float> precision(static_cast<std::size_t>(actions));
  double sum_log_std = 0.0;
  for (int j = 0; j < actions; ++j) {
    precision[j] = std::exp(-log_std[j]);
    sum_log_std += static_cast<double>(log_std[j]);
  }
  const float constant = static_cast<float>(sum_log_std + actions * 0.91893853320467274178);  // log(2 pi) / 2
  const float low = 1.0f - clip_range, high = 1.0f + clip_range, share = 1.0f / static_cast<float>(rows.count);
  double loss = 0.0, kl = 0.0;
  int clipped = 0;
  std::vector<double> spread(static_cast<std::size_t>(actions), 0.0);
  net.pass(rollout.observations, rows, [&](std::int64_t sample, const float* output, float* error) {
    const float* action = rollout.actions + sample * actions;
    float squares = 0.0f;
    for (int j = 0; j < actions; ++j) {
      const float deviation = (action[j] - output[j]) * precision[j];
      squares = std::fma(deviation, deviation, squares);  // explicit, so that the order of summation is fixed
      error[j] = deviation;
    }
    const float log_ratio = -0.5f * squares - constant - rollout.log_probs[sample];
    const float ratio = std::exp(log_ratio);
    const float advantage = (rollout.advantages[sample] - mean) * factor;
    const float held = ratio < low ? low : ratio > high ? high : ratio;
    const float free = advantage * ratio, bound = advantage * held;
    loss -= static_cast<double>(free < bound ? free : bound);
    kl += static_cast<double>((ratio - 1.0f) - log_ratio);
    clipped += std::fabs(ratio - 1.0f) > clip_range;
    const bool counts = (ratio >= low && ratio <= high) || free < bound;
    const float by_log_prob = counts ? -share * advantage * ratio : 0.0f;
    for (int j = 0; j < actions; ++j) {
      const float deviation = error[j];
      spread[j] += static_cast<double>(by_log_prob * (deviation * deviation - 1.0f));
      error[j] = by_log_prob * deviation * precision[j];
    }
  });
  net.write_gradient();
  if (log_std_gradient != nullptr)
    for (int j = 0; j < actions; ++j) log_std_gradient[j] = static_cast<float>(spread[j]);
  return {loss / rows.count, static_cast<double>(clipped) / rows.count, kl / rows.count};
}

double critic(const std::vector<Layer>& layers, const Rollout& rollout, const Rows& rows, float coefficient, Workspace& workspace) {
  Net net(layers, workspace);
  const float factor = 2.0f * coefficient / static_cast<float>(rows.count);
  double squares = 0.0;
  net.pass(rollout.observations, rows, [&](std::int64_t sample, const float* output, float* error) {
    const float off = *output - rollout.returns[sample];
    squares += static_cast<double>(off) * static_cast<double>(off);
    *error = factor * off;
  });
  net.write_gradient();
  return squares / rows.count;
}

}  // namespace

#define NAOSPRINT_TEXT_(text) #text
#define NAOSPRINT_TEXT(text) NAOSPRINT_TEXT_(text)
extern const Kernel kernel;
const Kernel kernel{NAOSPRINT_TEXT(NAOSPRINT_ISA), actor, critic};

}  // namespace naosprint::NAOSPRINT_ISA
