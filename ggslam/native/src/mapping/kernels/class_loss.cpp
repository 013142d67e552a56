// SPDX-License-Identifier: Apache-2.0
// With logits z = W x + b and z0 of nothing, the loss of a pixel of class t is log(e^z0 + sum_k e^z_k) - z_t; its
// gradient by z is d = softmax(z) - [k = t], that by x is W^T d, that by W is d x^T, that by b is d.
#include "mapping/class_loss.hpp"

#include <cmath>

#include "common/kernels/simd.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

// The logits of one identity vector, to z; returns the highest of them and of nothing's.
float logits_of(const ClassLossRows& rows, const float* x, int channels, float nothing, float* z) {
  Float highest = broadcast(nothing);
  for (std::size_t k = 0; k < rows.classes; k += kLanes) {
    Float value = load(rows.biases + k);
    for (int f = 0; f < channels; ++f) value += x[f] * load(rows.by_channel + f * rows.classes + k);
    store(z + k, value);
    highest = maximum(highest, value);
  }
  float most = highest[0];
  for (int lane = 1; lane < kLanes; ++lane) most = highest[lane] > most ? highest[lane] : most;
  return most;
}

// z becomes e^(z - highest); returns the sum.
float exponentials(float* z, std::size_t count, float highest) {
  Float total{};
  for (std::size_t k = 0; k < count; k += kLanes) {
    const Float e = exponential(load(z + k) - highest);
    store(z + k, e);
    total += e;
  }
  return sum(total);
}

}  // namespace

double class_loss_pixels(const ClassLossJob& job, const ClassLossRows& rows, float factor, std::int64_t begin,
                         std::int64_t end, float* scratch, float* sums, float* bias_sums) {
  const int channels = job.channels;
  float *d = scratch, *x = d + rows.classes, *dx = x + rows.channels;
  double loss = 0;
  for (std::int64_t i = begin; i < end; ++i) {
    float* out = job.d_features + i * channels;
    const int target = job.classes[i];
    if (target < 0) {
      __builtin_memset(out, 0, sizeof(float) * channels);
      continue;
    }
    __builtin_memcpy(x, job.features + i * channels, sizeof(float) * channels);  // with zeros behind it
    const float highest = logits_of(rows, x, channels, job.nothing_logit, d), right = d[target] - highest;
    const float total = exponentials(d, rows.classes, highest) + std::exp(job.nothing_logit - highest);
    loss += static_cast<double>(std::log(total)) - right;
    for (std::size_t k = 0; k < rows.classes; k += kLanes) store(d + k, factor / total * load(d + k));
    d[target] -= factor;
    for (std::size_t k = 0; k < rows.classes; k += kLanes) store(bias_sums + k, load(bias_sums + k) + load(d + k));
    for (std::size_t f = 0; f < rows.channels; f += kLanes) {
      const Float here = load(x + f);
      Float gradient{};
      for (std::size_t k = 0; k < static_cast<std::size_t>(job.class_count); ++k) {
        gradient += d[k] * load(rows.by_class + k * rows.channels + f);
        float* row = sums + k * rows.channels + f;
        store(row, load(row) + d[k] * here);
      }
      store(dx + f, gradient);
    }
    __builtin_memcpy(out, dx, sizeof(float) * channels);
  }
  return loss;
}

}  // namespace ggslam::GGSLAM_ISA
