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

// Ask for numbers that are needed soon.
inline void prefetch(const float* from, int count) {
  for (int k = 0; k < count; k += 16) __builtin_prefetch(from + k);
  __builtin_prefetch(from + count - 1);
}

inline Vector load(const float* from) { return *reinterpret_cast<const Unaligned*>(from); }
inline void store(float* to, Vector value) { *reinterpret_cast<Unaligned*>(to) = value; }
inline Vector splat(float value) { return value - Vector{}; }  // the sum of 0 and -0 is 0, so adding would take an addition
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

// A number of one half: the sum or difference of a pair, or a single number, for which `right` is negative.
struct Entry {
  int left, right;
  float sign;
};

// The numbers of a vector, or of one of its halves.
std::vector<Entry> entries(const std::vector<Mirror>& mirrors, std::size_t which, int width, int half) {
  std::vector<Entry> found;
  if (mirrors.empty()) {
    for (int i = 0; i < width; ++i) found.push_back({i, -1, 1.0f});
    return found;
  }
  const Mirror& mirror = mirrors[which];
  for (const Mirror::Pair& pair : mirror.pairs) found.push_back({pair.left, pair.right, half == 0 ? pair.sign : -pair.sign});
  for (int single : half == 0 ? mirror.even : mirror.odd) found.push_back({single, -1, 1.0f});
  return found;
}

// The matrix of a layer, or of one of its halves, in the layouts of the products.
struct Matrix {
  int inputs, outputs;
  int in, out;      // padded
  float* forward;   // (inputs, padded outputs)
  float* backward;  // (outputs, padded inputs)
  float* gradient;  // (padded outputs, padded inputs)
};

// A vector of every row of a tile, or one of its halves.
struct Tile {
  int width;      // padded
  float* values;  // (kTile, width): inputs, or outputs of a layer after tanh
  float* errors;  // (kTile, width): derivatives by them before tanh
};

// A network with room for the activations of one tile.
struct Net {
  const Network& network;
  const int halves;                           // 1 if the network is not symmetric
  std::vector<std::vector<Matrix>> matrices;  // of each layer
  std::vector<std::vector<Tile>> tiles;       // inputs, then the outputs of each layer
  std::vector<float*> bias, bias_gradient;    // of each layer's first half; that of the odd half is zero
  std::vector<float> output, error;           // of the rows of a tile, whole

  Net(const Network& given, Workspace& workspace) : network(given), halves(given.mirrors.empty() ? 1 : 2) {
    const std::vector<Layer>& layers = network.layers;
    std::vector<std::vector<std::vector<Entry>>> numbers(layers.size() + 1);
    std::size_t floats = 0;
    for (std::size_t l = 0; l <= layers.size(); ++l)
      for (int h = 0; h < halves; ++h) {
        numbers[l].push_back(entries(network.mirrors, l, l == 0 ? layers[0].inputs : layers[l - 1].outputs, h));
        const std::size_t width = static_cast<std::size_t>(padded(static_cast<int>(numbers[l][h].size())));
        floats += 2 * (kTile + 1) * width + 4 * 16;
        if (l > 0) floats += 3 * width * static_cast<std::size_t>(padded(static_cast<int>(numbers[l - 1][h].size()))) + 3 * 16;
      }
    workspace.reserve(floats);
    workspace.begin();
    const auto zeros = [&](std::size_t count) {
      float* at = workspace.take(count);
      std::memset(at, 0, sizeof(float) * count);
      return at;
    };
    for (std::size_t l = 0; l <= layers.size(); ++l) {
      tiles.emplace_back();
      for (int h = 0; h < halves; ++h) {
        const int width = padded(static_cast<int>(numbers[l][h].size()));
        tiles[l].push_back({width, zeros(static_cast<std::size_t>(kTile) * width), zeros(static_cast<std::size_t>(kTile) * width)});
      }
    }
    for (std::size_t l = 0; l < layers.size(); ++l) {
      const Layer& layer = layers[l];
      matrices.emplace_back();
      for (int h = 0; h < halves; ++h) {
        const std::vector<Entry>&columns = numbers[l][h], &rows = numbers[l + 1][h];
        const int in = tiles[l][h].width, out = tiles[l + 1][h].width;
        const std::size_t size = static_cast<std::size_t>(in) * out;
        const Matrix matrix{static_cast<int>(columns.size()), static_cast<int>(rows.size()), in, out, zeros(size), zeros(size), zeros(size)};
        for (int r = 0; r < matrix.outputs; ++r) {
          const float* weights = layer.weight + static_cast<std::size_t>(rows[r].left) * layer.inputs;
          for (int k = 0; k < matrix.inputs; ++k) {
            const Entry& column = columns[k];
            const float left = weights[column.left];
            const float weight = column.right < 0 ? left : 0.5f * (left + column.sign * weights[column.right]);
            matrix.forward[static_cast<std::size_t>(k) * out + r] = weight;
            matrix.backward[static_cast<std::size_t>(r) * in + k] = weight;
          }
        }
        matrices[l].push_back(matrix);
      }
      const std::vector<Entry>& rows = numbers[l + 1][0];
      bias.push_back(zeros(static_cast<std::size_t>(tiles[l + 1][0].width)));
      bias_gradient.push_back(zeros(static_cast<std::size_t>(tiles[l + 1][0].width)));
      for (std::size_t r = 0; r < rows.size(); ++r) bias[l][r] = layer.bias[rows[r].left];
    }
    output.resize(static_cast<std::size_t>(kTile) * layers.back().outputs);
    error.resize(output.size());
  }

  // Load the observations of up to kTile rows; further rows are zero.
  void gather(const float* observations, const std::int64_t* index, int count) {
    const int whole = network.layers[0].inputs;
    int first = 0;
    for (int h = 0; h < halves; ++h) {
      const Tile& tile = tiles[0][h];
      const int inputs = matrices[0][h].inputs;
      for (int r = 0; r < count; ++r)
        std::memcpy(tile.values + static_cast<std::size_t>(r) * tile.width, observations + index[r] * whole + first, sizeof(float) * inputs);
      std::memset(tile.values + static_cast<std::size_t>(count) * tile.width, 0, sizeof(float) * (kTile - count) * tile.width);
      first += inputs;
    }
  }

  // Compute the outputs, which are the values of the last tiles.
  void run() {
    for (std::size_t l = 0; l < matrices.size(); ++l) {
      for (int h = 0; h < halves; ++h) {
        const Matrix& matrix = matrices[l][h];
        multiply<false>(kTile, matrix.out, matrix.inputs, tiles[l][h].values, matrix.in, 1, matrix.forward, matrix.out, tiles[l + 1][h].values,
                        matrix.out);
      }
      const Tile& first = tiles[l + 1][0];
      const bool squash = l + 1 < matrices.size();
      float* mirrored = squash && halves == 2 ? tiles[l + 1][1].values : nullptr;
      for (int r = 0; r < kTile; ++r)
        for (int v = 0; v < first.width; v += kWidth) {
          const std::size_t at = static_cast<std::size_t>(r) * first.width + v;
          const Vector sum = load(first.values + at) + load(bias[l] + v);
          if (mirrored != nullptr) {
            const Vector difference = load(mirrored + at), left = tanh(sum + difference), right = tanh(sum - difference);
            store(first.values + at, left + right);
            store(mirrored + at, left - right);
          } else {
            store(first.values + at, squash ? tanh(sum) : sum);
          }
        }
    }
  }

  // Add the tile's gradient, given the derivatives by the outputs in the errors of the last tiles, zero for rows that do not count.
  void learn() {
    for (std::size_t l = matrices.size(); l-- > 0;) {
      for (int h = 0; h < halves; ++h) {
        const Matrix& matrix = matrices[l][h];
        const Tile &inputs = tiles[l][h], &outputs = tiles[l + 1][h];
        multiply<true>(matrix.out, matrix.in, kTile, outputs.errors, 1, matrix.out, inputs.values, matrix.in, matrix.gradient, matrix.in);
        if (l > 0)
          multiply<false>(kTile, matrix.in, matrix.outputs, outputs.errors, matrix.out, 1, matrix.backward, matrix.in, inputs.errors, matrix.in);
      }
      const Tile& first = tiles[l + 1][0];
      for (int v = 0; v < first.width; v += kWidth) {
        Vector sum = load(bias_gradient[l] + v);
        for (int r = 0; r < kTile; ++r) sum += load(first.errors + static_cast<std::size_t>(r) * first.width + v);
        store(bias_gradient[l] + v, sum);
      }
      if (l > 0) squash_errors(tiles[l]);
    }
  }

  // Multiply derivatives by a layer's outputs by the derivative of tanh.
  static void squash_errors(const std::vector<Tile>& layer) {
    const Tile& first = layer[0];
    for (std::size_t at = 0; at < static_cast<std::size_t>(kTile) * first.width; at += kWidth) {
      const Vector values = load(first.values + at), errors = load(first.errors + at);
      if (layer.size() == 1) {
        store(first.errors + at, errors * (1.0f - values * values));
        continue;
      }
      const Vector differences = load(layer[1].values + at), others = load(layer[1].errors + at);
      const Vector left = 0.5f * (values + differences), right = 0.5f * (values - differences);
      const Vector by_left = (errors + others) * (1.0f - left * left), by_right = (errors - others) * (1.0f - right * right);
      store(first.errors + at, by_left + by_right);
      store(layer[1].errors + at, by_left - by_right);
    }
  }

  // Add the gradient of all rows. `differentiate(sample, outputs, errors)` fills in the derivatives by one sample's outputs;
  // `fetch(sample)` asks for the numbers that it will read.
  template <class Fetch, class Differentiate>
  void pass(const float* observations, const Rows& rows, Fetch fetch, Differentiate differentiate) {
    for (int first = 0; first < rows.count; first += kTile) {
      const int count = rows.count - first < kTile ? rows.count - first : kTile;
      const std::int64_t* index = rows.index + first;
      gather(observations, index, count);
      // the rows are anywhere in the rollout: ask for them one tile earlier than they are needed
      const int whole = network.layers[0].inputs, next = rows.count - first - count < kTile ? rows.count - first - count : kTile;
      for (int r = 0; r < count; ++r) fetch(index[r]);
      for (int r = count; r < count + next; ++r) prefetch(observations + index[r] * whole, whole);
      run();
      for (const Tile& tile : tiles.back()) std::memset(tile.errors, 0, sizeof(float) * kTile * tile.width);
      const std::size_t width = halves == 1 ? static_cast<std::size_t>(tiles.back()[0].width) : static_cast<std::size_t>(network.layers.back().outputs);
      const float* outputs = halves == 1 ? tiles.back()[0].values : output.data();
      float* errors = halves == 1 ? tiles.back()[0].errors : error.data();
      // row by row, but one step of the work at a time: a processor waits for numbers that were written one by one a moment ago
      for (int r = 0; halves == 2 && r < count; ++r) join(r, output.data() + r * width);
      for (int r = 0; r < count; ++r) differentiate(index[r], outputs + r * width, errors + r * width);
      for (int r = 0; halves == 2 && r < count; ++r) part(r, error.data() + r * width);
      learn();
    }
  }

  // Put the outputs of one row together.
  void join(int row, float* outputs) const {
    const Mirror& mirror = network.mirrors.back();
    const Tile &even = tiles.back()[0], &odd = tiles.back()[1];
    const float *sums = even.values + static_cast<std::size_t>(row) * even.width, *differences = odd.values + static_cast<std::size_t>(row) * odd.width;
    for (const Mirror::Pair& pair : mirror.pairs) {
      outputs[pair.left] = *sums + *differences;
      outputs[pair.right] = pair.sign * (*sums++ - *differences++);
    }
    for (int single : mirror.even) outputs[single] = *sums++;
    for (int single : mirror.odd) outputs[single] = *differences++;
  }

  // Take the derivatives of one row apart.
  void part(int row, const float* errors) const {
    const Mirror& mirror = network.mirrors.back();
    const Tile &even = tiles.back()[0], &odd = tiles.back()[1];
    float *sums = even.errors + static_cast<std::size_t>(row) * even.width, *differences = odd.errors + static_cast<std::size_t>(row) * odd.width;
    for (const Mirror::Pair& pair : mirror.pairs) {
      *sums++ = errors[pair.left] + pair.sign * errors[pair.right];
      *differences++ = errors[pair.left] - pair.sign * errors[pair.right];
    }
    for (int single : mirror.even) *sums++ = errors[single];
    for (int single : mirror.odd) *differences++ = errors[single];
  }

  void write_gradient() const {
    for (std::size_t l = 0; l < matrices.size(); ++l) {
      const Layer& layer = network.layers[l];
      if (halves == 2) {
        write_mirrored(layer, l);
        continue;
      }
      for (int r = 0; r < layer.outputs; ++r) {
        const std::size_t width = static_cast<std::size_t>(layer.inputs);
        std::memcpy(layer.weight_gradient + r * width, matrices[l][0].gradient + static_cast<std::size_t>(r) * matrices[l][0].in,
                    sizeof(float) * width);
        layer.bias_gradient[r] = bias_gradient[l][r];
      }
    }
  }

  // The mean of the gradients of mirrored weights, with the sign of each.
  void write_mirrored(const Layer& layer, std::size_t l) const {
    const Mirror &columns = network.mirrors[l], &rows = network.mirrors[l + 1];
    const Matrix &even = matrices[l][0], &odd = matrices[l][1];
    const std::size_t width = static_cast<std::size_t>(layer.inputs), column_pairs = columns.pairs.size();
    std::memset(layer.weight_gradient, 0, sizeof(float) * width * layer.outputs);
    const float *sums = even.gradient, *differences = odd.gradient, *bias = bias_gradient[l];
    for (const Mirror::Pair& row : rows.pairs) {
      float *left = layer.weight_gradient + row.left * width, *right = layer.weight_gradient + row.right * width;
      for (std::size_t k = 0; k < column_pairs; ++k) {
        const Mirror::Pair& column = columns.pairs[k];
        const float same = 0.25f * (sums[k] + differences[k]), crossed = 0.25f * (sums[k] - differences[k]);
        left[column.left] = same;
        left[column.right] = column.sign * crossed;
        right[column.left] = row.sign * crossed;
        right[column.right] = row.sign * column.sign * same;
      }
      for (std::size_t k = 0; k < columns.even.size(); ++k) {
        left[columns.even[k]] = 0.5f * sums[column_pairs + k];
        right[columns.even[k]] = row.sign * left[columns.even[k]];
      }
      for (std::size_t k = 0; k < columns.odd.size(); ++k) {
        left[columns.odd[k]] = 0.5f * differences[column_pairs + k];
        right[columns.odd[k]] = -row.sign * left[columns.odd[k]];
      }
      layer.bias_gradient[row.left] = 0.5f * *bias++;
      layer.bias_gradient[row.right] = row.sign * layer.bias_gradient[row.left];
      sums += even.in;
      differences += odd.in;
    }
    for (int row : rows.even) {
      write_single(columns, sums, columns.even, 1.0f, layer.weight_gradient + row * width);
      layer.bias_gradient[row] = *bias++;
      sums += even.in;
    }
    for (int row : rows.odd) {
      write_single(columns, differences, columns.odd, -1.0f, layer.weight_gradient + row * width);
      layer.bias_gradient[row] = 0.0f;
      differences += odd.in;
    }
  }

  // The row of an output that is its own mirror image.
  static void write_single(const Mirror& columns, const float* gradient, const std::vector<int>& singles, float sign, float* row) {
    for (const Mirror::Pair& column : columns.pairs) {
      row[column.left] = 0.5f * *gradient++;
      row[column.right] = sign * column.sign * row[column.left];
    }
    for (int column : singles) row[column] = *gradient++;
  }
};

ActorResult actor(const Network& network, const float* log_std, float* log_std_gradient, const Rollout& rollout, const Rows& rows,
                  bool normalize_advantages, float clip_range, Workspace& workspace) {
  Net net(network, workspace);
  const int actions = network.layers.back().outputs;
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
  const auto fetch = [&](std::int64_t sample) {
    prefetch(rollout.actions + sample * actions, actions);
    prefetch(rollout.log_probs + sample, 1);
    prefetch(rollout.advantages + sample, 1);
  };
  net.pass(rollout.observations, rows, fetch, [&](std::int64_t sample, const float* output, float* error) {
    const float* action = rollout.actions + sample * actions;
    for (int j = 0; j < actions; ++j) error[j] = (action[j] - output[j]) * precision[j];
    float squares[4] = {};  // explicit, so that the order of summation is fixed
    for (int j = 0; j < actions; ++j) squares[j % 4] = std::fma(error[j], error[j], squares[j % 4]);
    const float log_ratio = -0.5f * ((squares[0] + squares[1]) + (squares[2] + squares[3])) - constant - rollout.log_probs[sample];
    const float ratio = std::exp(log_ratio);
    const float advantage = (rollout.advantages[sample] - mean) * factor;
    const float held = ratio < low ? low : ratio > high ? high : ratio;
    const float free = advantage * ratio, bound = advantage * held;
    loss -= static_cast<double>(free < bound ? free : bound);
    kl += static_cast<double>((ratio - 1.0f) - log_ratio);
    clipped += std::fabs(ratio - 1.0f) > clip_range;
    const bool counts = (ratio >= low && ratio <= high) || free < bound;
    const float by_log_prob = counts ? -share * advantage * ratio : 0.0f;
    if (log_std_gradient != nullptr)
      for (int j = 0; j < actions; ++j) spread[j] += static_cast<double>(by_log_prob * (error[j] * error[j] - 1.0f));
    for (int j = 0; j < actions; ++j) error[j] *= by_log_prob * precision[j];
  });
  net.write_gradient();
  if (log_std_gradient != nullptr)
    for (int j = 0; j < actions; ++j) log_std_gradient[j] = static_cast<float>(spread[j]);
  return {loss / rows.count, static_cast<double>(clipped) / rows.count, kl / rows.count};
}

double squared(const Network& network, const Rollout& rollout, const Rows& rows, float coefficient, Workspace& workspace) {
  Net net(network, workspace);
  const int outputs = network.layers.back().outputs;
  const double count = static_cast<double>(rows.count) * outputs;
  const float factor = 2.0f * coefficient / static_cast<float>(count);
  double squares = 0.0;
  const auto fetch = [&](std::int64_t sample) { prefetch(rollout.targets + sample * outputs, outputs); };
  net.pass(rollout.observations, rows, fetch, [&](std::int64_t sample, const float* output, float* error) {
    const float* target = rollout.targets + sample * outputs;
    for (int j = 0; j < outputs; ++j) {
      const float off = output[j] - target[j];
      squares += static_cast<double>(off) * static_cast<double>(off);
      error[j] = factor * off;
    }
  });
  net.write_gradient();
  return squares / count;
}

}  // namespace

#define NAOSPRINT_TEXT_(text) #text
#define NAOSPRINT_TEXT(text) NAOSPRINT_TEXT_(text)
extern const Kernel kernel;
const Kernel kernel{NAOSPRINT_TEXT(NAOSPRINT_ISA), actor, squared};

}  // namespace naosprint::NAOSPRINT_ISA
