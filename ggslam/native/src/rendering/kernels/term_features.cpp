// SPDX-License-Identifier: Apache-2.0
// Features at sampled pixels, and the optimizer's step on the Gaussians that the pixels are made of.
#include "rendering/pixel_terms.hpp"
#include "common/kernels/simd.hpp"

namespace ggslam::GGSLAM_ISA {

void blend_terms(const PixelTerms& terms, const float* features, int channels, std::int64_t begin, std::int64_t end,
                 float* out) {
  for (std::int64_t p = begin; p < end; ++p) {
    alignas(64) float sums[kMaxTermChannels] = {};
    const std::int32_t* gaussians = terms.gaussians + p * terms.capacity;
    const float* weights = terms.weights + p * terms.capacity;
    for (int i = 0; i < terms.counts[p]; ++i) {
      const float* row = features + static_cast<std::size_t>(gaussians[i]) * channels;
      for (int q = 0; q < channels; ++q) sums[q] += weights[i] * row[q];
    }
    __builtin_memcpy(out + p * channels, sums, sizeof(float) * channels);
  }
}

namespace {

inline float from_bfloat16(std::uint16_t bits) { return __builtin_bit_cast(float, static_cast<std::uint32_t>(bits) << 16); }

// Rounded to the nearest.
inline std::uint16_t to_bfloat16(float value) {
  return static_cast<std::uint16_t>((__builtin_bit_cast(std::uint32_t, value) + 0x8000u) >> 16);
}

// One Gaussian's step with compact moments: what its channels' gradients are as a whole decides how far each goes.
void step_compact(const FeatureAdam& adam, std::size_t gaussian, const float* gradient, const float* line) {
  const int channels = adam.channels;
  float squares = 0;
  for (int q = 0; q < channels; ++q) squares += gradient[q] * gradient[q];
  float& second = adam.second_moments[gaussian];
  second = adam.beta2 * second + (1.0f - adam.beta2) * squares / static_cast<float>(channels);
  const float rate = line[0] / (__builtin_sqrtf(second) * line[1] + adam.epsilon);
  float* features = adam.features + gaussian * channels;
  std::uint16_t* moments = adam.short_moments + gaussian * channels;
  for (int q = 0; q < channels; ++q) {
    const float first = adam.beta1 * from_bfloat16(moments[q]) + (1.0f - adam.beta1) * gradient[q];
    moments[q] = to_bfloat16(first);
    features[q] -= rate * first;
  }
}

}  // namespace

void step_term_rows(const TermsByGaussian& terms, const float* gradient, const FeatureAdam& adam, std::int64_t begin,
                    std::int64_t end) {
  const int channels = adam.channels;
  for (std::int64_t i = begin; i < end; ++i) {
    alignas(64) float sums[kMaxTermChannels] = {};
    for (std::int64_t k = terms.starts[i]; k < terms.starts[i + 1]; ++k) {
      const float* row = gradient + static_cast<std::size_t>(terms.rows[k]) * channels;
      for (int q = 0; q < channels; ++q) sums[q] += terms.weights[k] * row[q];
    }
    const std::size_t gaussian = terms.touched[i], at = gaussian * channels;
    const std::int32_t count = adam.updates[gaussian] = next_update(adam.updates[gaussian]);
    const float* line = adam.schedule + 2 * schedule_row(count, adam.schedule_rows);
    if (adam.short_moments != nullptr) {
      step_compact(adam, gaussian, sums, line);
      continue;
    }
    float *features = adam.features + at, *first = adam.first_moments + at, *second = adam.second_moments + at;
    for (int q = 0; q < channels; ++q) {
      first[q] = adam.beta1 * first[q] + (1.0f - adam.beta1) * sums[q];
      second[q] = adam.beta2 * second[q] + (1.0f - adam.beta2) * sums[q] * sums[q];
      features[q] -= line[0] * first[q] / (__builtin_sqrtf(second[q]) * line[1] + adam.epsilon);
    }
  }
}

}  // namespace ggslam::GGSLAM_ISA
