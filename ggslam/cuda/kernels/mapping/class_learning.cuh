// SPDX-License-Identifier: Apache-2.0
// Softmax losses of identity learning and their gradients, as in ggslam/mapping/cpu/identity.py and neighbours.py. Products
// with the classifier's matrix are left to the caller: what is here turns logits into gradients, a warp for each row.
#pragma once
#include "common/platform.cuh"
#include "abi/cuda/mapping.hpp"

namespace ggslam::cuda {

constexpr int kClassThreads = 256;
constexpr int kClassWarps = kClassThreads / kWarp;
constexpr float kNothingLogit = 1.0f;                                     // NOTHING_LOGIT of ggslam/scene/identity.py
constexpr float kLogBeta1 = -0.1053605157f, kLogBeta2 = -0.001000500334f;  // of 0.9 and 0.999

__global__ void __launch_bounds__(kClassThreads) pixel_labels_kernel(PixelClassJob job) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kClassThreads + threadIdx.x;
  if (i < job.count) job.labels[i] = job.alias[job.mask[job.pixels[i]]];
}

__global__ void __launch_bounds__(kClassThreads) pixel_classes_kernel(PixelClassJob job) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kClassThreads + threadIdx.x;
  const std::int32_t number = i < job.count ? job.class_of[job.labels[i]] : -1;
  if (i < job.count) job.classes[i] = number;
  const int known = __syncthreads_count(number >= 0);
  if (threadIdx.x == 0 && known > 0) atomicAdd(job.known, known);
}

__device__ inline float sum_of_lanes(float value) {
  for (int bits = kWarp / 2; bits > 0; bits /= 2) value += __shfl_xor_sync(kAllLanes, value, bits);
  return value;
}

// A softmax over logits and that of being nothing: log of a probability = logit - highest - log_sum.
struct Normaliser {
  float highest, log_sum;
  __device__ float log_probability(float logit) const { return logit - highest - log_sum; }
};

// Of a row of logits; by a whole warp.
__device__ inline Normaliser normalise(const float* logits, int classes, int lane) {
  float highest = kNothingLogit, sum = 0.0f;
  for (int c = lane; c < classes; c += kWarp) highest = fmaxf(highest, logits[c]);
  for (int bits = kWarp / 2; bits > 0; bits /= 2) highest = fmaxf(highest, __shfl_xor_sync(kAllLanes, highest, bits));
  for (int c = lane; c < classes; c += kWarp) sum += expf(logits[c] - highest);
  return {highest, logf(sum_of_lanes(sum) + expf(kNothingLogit - highest))};
}

// weight / known * softmax cross-entropy by the logits.
__global__ void __launch_bounds__(kClassThreads) cross_entropy_kernel(CrossEntropyJob job) {
  const std::int64_t row = static_cast<std::int64_t>(blockIdx.x) * kClassWarps + threadIdx.x / kWarp;
  if (row >= job.count) return;  // whole warps
  const int lane = static_cast<int>(threadIdx.x) % kWarp;
  const std::int32_t target = job.targets[row];
  float* logits = job.logits + row * job.classes;
  if (target < 0) {
    for (int c = lane; c < job.classes; c += kWarp) logits[c] = 0.0f;
    if (lane == 0) job.losses[row] = 0.0f;
    return;
  }
  const Normaliser softmax = normalise(logits, job.classes, lane);
  const float scale = job.weight / static_cast<float>(*job.known);
  for (int c = lane; c < job.classes; c += kWarp) {
    const float log_probability = softmax.log_probability(logits[c]);
    logits[c] = scale * (expf(log_probability) - (c == target ? 1.0f : 0.0f));
    if (c == target) job.losses[row] = -log_probability;
  }
}

// weight * mean over pairs of KL(P || Q) by the logits of P, a sample, and Q, a neighbour.
__global__ void __launch_bounds__(kClassThreads) neighbour_loss_kernel(NeighbourLossJob job) {
  const std::int64_t sample = static_cast<std::int64_t>(blockIdx.x) * kClassWarps + threadIdx.x / kWarp;
  if (sample >= job.samples) return;  // whole warps
  const int lane = static_cast<int>(threadIdx.x) % kWarp, classes = job.classes;
  const float scale = job.weight / (static_cast<float>(job.samples) * static_cast<float>(job.neighbours));
  const float* logits = job.logits + sample * classes;
  float* gradient = job.gradients + sample * classes;
  const Normaliser p = normalise(logits, classes, lane);
  const float log_nothing = p.log_probability(kNothingLogit);
  for (int c = lane; c < classes; c += kWarp) gradient[c] = 0.0f;
  for (int k = 0; k < job.neighbours; ++k) {
    const std::int64_t row = job.samples + sample * job.neighbours + k;
    const float* others = job.logits + row * classes;
    const Normaliser q = normalise(others, classes, lane);
    float kl = 0.0f;
    for (int c = lane; c < classes; c += kWarp) {
      const float log_p = p.log_probability(logits[c]);
      kl += expf(log_p) * (log_p - q.log_probability(others[c]));
    }
    kl = sum_of_lanes(kl) + expf(log_nothing) * (log_nothing - q.log_probability(kNothingLogit));
    for (int c = lane; c < classes; c += kWarp) {
      const float log_p = p.log_probability(logits[c]), log_q = q.log_probability(others[c]), likely = expf(log_p);
      gradient[c] += scale * likely * (log_p - log_q - kl);
      job.gradients[row * classes + c] = scale * (expf(log_q) - likely);
    }
  }
}

// Adam (0.9, 0.999) on the classifier.
__global__ void __launch_bounds__(kClassThreads) class_adam_kernel(ClassAdamJob job) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kClassThreads + threadIdx.x;
  if (i >= job.size || *job.known == 0) return;
  const float step = static_cast<float>(*job.steps + 1), gradient = job.gradients[i];
  const float first = job.first_moments[i] + 0.1f * (gradient - job.first_moments[i]);
  const float second = job.second_moments[i] + 0.001f * (gradient * gradient - job.second_moments[i]);
  job.first_moments[i] = first;
  job.second_moments[i] = second;
  // 1 - beta^step as it stands would lose half its digits at the first steps.
  const float first_correction = -expm1f(step * kLogBeta1), second_correction = -expm1f(step * kLogBeta2);
  job.rows[i] -= job.rate / first_correction * first / (sqrtf(second / second_correction) + 1e-15f);
}

__global__ void count_step_kernel(ClassAdamJob job) {
  if (threadIdx.x == 0 && *job.known > 0) *job.steps += 1;
}

}  // namespace ggslam::cuda
