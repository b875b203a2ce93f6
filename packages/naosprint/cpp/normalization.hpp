// Running normalization of observations and rewards; naosprint.rl.normalization has the same in Python, with the same bits.
#pragma once
#include <cstdint>
#include <vector>

namespace naosprint {

// Mean and variance of a stream of samples of `width` numbers, and how many samples each of these has.
struct Moments {
  double *mean, *variance, *count;
  int width;
};

// Left-right symmetry of samples: mirrored[j] = sign[j] * sample[index[j]]; no index for none.
struct MirrorImage {
  const std::int64_t* index;
  const double* sign;
};

// Merge (rows, width) samples into the moments.
void merge(const Moments& moments, const MirrorImage& mirror, const double* samples, std::int64_t rows, std::uint64_t threads);

// Write the standardized and clipped samples; return whether they are finite.
bool standardize(const Moments& moments, const double* samples, std::int64_t rows, double clip, float* out, std::uint64_t threads);

// Merge the discounted returns, and write the rewards divided by the returns' spread and clipped. Returns of episodes that are over become 0.
void scale_rewards(const Moments& moments, double* returns, const double* rewards, const bool* dones, std::int64_t rows, double gamma, double clip,
                   float* out);

}  // namespace naosprint
