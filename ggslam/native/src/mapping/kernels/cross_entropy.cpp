// SPDX-License-Identifier: Apache-2.0
// Cross-entropy of classified features. Logits and probabilities have a pixel in each lane; gradients go channel by
// channel, which is what lies side by side in features and weights.
#include "mapping/cross_entropy.hpp"

#include <cmath>

#include "common/kernels/simd.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

constexpr int kIdentityChannels = 16;  // of the identity vectors, compiled as a constant

// Logits of the pixels [begin, begin + lanes) that there are, others those of a vector of zeros; returns the highest.
Float fill_logits(const CrossEntropyOfPixels& job, std::int64_t begin, int lanes, int channels, float* logits) {
  alignas(64) float columns[kMostEntropyChannels * kLanes] = {};
  for (int lane = 0; lane < lanes; ++lane)
    for (int c = 0; c < channels; ++c) columns[c * kLanes + lane] = job.features[(begin + lane) * channels + c];
  Float highest = broadcast(job.nothing_logit);
  for (int k = 0; k < job.count; ++k) {
    const float* weight = job.weight + static_cast<std::int64_t>(k) * channels;
    Float z = broadcast(job.bias[k]);
    for (int c = 0; c < channels; ++c) z += weight[c] * load(columns + c * kLanes);
    store(logits + k * kLanes, z);
    highest = maximum(highest, z);
  }
  return highest;
}

// Logits become what multiplies a pixel's features and the weights in the gradients.
void to_gradients(const CrossEntropyOfPixels& job, std::int64_t begin, int lanes, Float highest, float share,
                  float* logits, float* right, float* log_sums) {
  for (int lane = 0; lane < lanes; ++lane)
    if (const std::int32_t k = job.classes[begin + lane]; k >= 0) right[lane] = logits[k * kLanes + lane];
  Float sums = exponential(broadcast(job.nothing_logit) - highest);
  for (int k = 0; k < job.count; ++k) {
    const Float e = exponential(load(logits + k * kLanes) - highest);
    sums += e;
    store(logits + k * kLanes, e);
  }
  store(log_sums, log2(sums) * 0.693147181f + highest);
  const Float factor = share / sums;
  for (int k = 0; k < job.count; ++k) store(logits + k * kLanes, factor * load(logits + k * kLanes));
}

// Gradients of a pixel whose true class is `own`, with those of the logits in `lane`.
template <int kChannels>
void spread(const CrossEntropyOfPixels& job, std::int64_t pixel, int lane, float* logits, float* rows) {
  const int channels = kChannels ? kChannels : job.channels;
  const float* feature = job.features + pixel * channels;
  float gradient[kChannels ? kChannels : kMostEntropyChannels] = {};
  for (int k = 0; k < job.count; ++k) {
    const float z = logits[k * kLanes + lane];
    const float* weight = job.weight + static_cast<std::int64_t>(k) * channels;
    float* row = rows + static_cast<std::int64_t>(k) * (channels + 1);
    for (int c = 0; c < channels; ++c) gradient[c] += z * weight[c];
    for (int c = 0; c < channels; ++c) row[c] += z * feature[c];
    row[channels] += z;
  }
  for (int c = 0; c < channels; ++c) job.d_features[pixel * channels + c] = gradient[c];
}

template <int kChannels>
double add_part(const CrossEntropyOfPixels& job, std::int64_t begin, std::int64_t end, float share, float* logits,
                float* rows) {
  const int channels = kChannels ? kChannels : job.channels;
  double loss = 0;
  for (std::int64_t first = begin; first < end; first += kLanes) {
    const int lanes = end - first < kLanes ? static_cast<int>(end - first) : kLanes;
    alignas(64) float right[kLanes] = {}, log_sums[kLanes];
    const Float highest = fill_logits(job, first, lanes, channels, logits);
    to_gradients(job, first, lanes, highest, share, logits, right, log_sums);
    for (int lane = 0; lane < lanes; ++lane) {
      const std::int32_t own = job.classes[first + lane];
      if (own < 0) {
        for (int c = 0; c < channels; ++c) job.d_features[(first + lane) * channels + c] = 0;
        continue;
      }
      loss += static_cast<double>(log_sums[lane]) - static_cast<double>(right[lane]);
      logits[own * kLanes + lane] -= share;
      spread<kChannels>(job, first + lane, lane, logits, rows);
    }
  }
  return loss;
}

}  // namespace

double cross_entropy_part(const CrossEntropyOfPixels& job, std::int64_t begin, std::int64_t end, float share,
                          float* logits, float* rows) {
  return job.channels == kIdentityChannels ? add_part<kIdentityChannels>(job, begin, end, share, logits, rows)
                                           : add_part<0>(job, begin, end, share, logits, rows);
}

}  // namespace ggslam::GGSLAM_ISA
