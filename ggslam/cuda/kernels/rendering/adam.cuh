// SPDX-License-Identifier: Apache-2.0
// Adam (Kingma and Ba 2015) on the rows of the Gaussians that were touched, as in native/src/rendering/kernels/adam.hpp and
// ggslam/rendering/adam.py: every row counts its own updates, so learning rate and bias corrections are per row. They
// are computed here rather than looked up, so that other rates need nothing but other arguments.
#pragma once
#include "common/platform.cuh"
#include "abi/cuda/rendering.hpp"

namespace ggslam::cuda {

// What all parameters of a Gaussian share at its u-th update.
struct AdamFactors {
  float decay;       // of the rates of decayed groups
  float fall;        // of those of falling groups
  float rate;        // 1 / (1 - beta1^u)
  float correction;  // 1 / sqrt(1 - beta2^u)
};

__device__ inline AdamFactors adam_factors(const AdamStep& adam, std::int32_t update) {
  const float u = static_cast<float>(update);
  // 1 - beta^u as it stands would lose half its digits at the first updates.
  return {fmaxf(adam.decay_floor, expf((u - 1.0f) * adam.log_decay)),
          fmaxf(adam.fall_floor, 1.0f / sqrtf(1.0f + (u - 1.0f) * adam.fall_rate)),
          1.0f / -expm1f(u * adam.log_beta1), 1.0f / sqrtf(-expm1f(u * adam.log_beta2))};
}

__device__ inline float step_size(const AdamStep& adam, const AdamFactors& factors, AdamGroup group) {
  const float decay = ((adam.decayed_groups >> group) & 1) != 0 ? factors.decay : 1.0f;
  const float fall = ((adam.falling_groups >> group) & 1) != 0 ? factors.fall : 1.0f;
  const float rate = adam.current_rates != nullptr ? adam.current_rates[group] : adam.rates[group];
  return rate * decay * fall * factors.rate;
}

// One parameter.
__device__ inline void step_parameter(const AdamStep& adam, const AdamArrays& arrays, std::int64_t index,
                                      float gradient, float step, float correction) {
  const float first = adam.beta1 * arrays.first_moments[index] + (1.0f - adam.beta1) * gradient;
  const float second = adam.beta2 * arrays.second_moments[index] + (1.0f - adam.beta2) * gradient * gradient;
  arrays.first_moments[index] = first;
  arrays.second_moments[index] = second;
  arrays.parameters[index] -= step * first / (sqrtf(second) * correction + adam.epsilon);
}

}  // namespace ggslam::cuda
