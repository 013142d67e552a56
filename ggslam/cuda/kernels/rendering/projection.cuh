// SPDX-License-Identifier: Apache-2.0
// The projection of a Gaussian.
#pragma once
#include "rendering/rules.cuh"
#include "native/formulas/projection.hpp"

namespace ggslam::cuda {

// What a kernel does first: takes the pose from where Rendering's pose leads, if that is not null.
__device__ inline void read_pose(const float* pose, ViewConstants& c) {
  if (pose == nullptr) return;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) c.W[i][j] = pose[4 * i + j];
    c.t[i] = pose[4 * i + 3];
  }
}

__device__ inline RawGaussian load_gaussian(const GaussianArrays& arrays, std::int64_t row) {
  RawGaussian g;
  for (int k = 0; k < 3; ++k) g.mean[k] = arrays.means[3 * row + k];
  for (int k = 0; k < 4; ++k) g.quaternion[k] = arrays.quaternions[4 * row + k];
  for (int k = 0; k < 3; ++k) g.log_scale[k] = arrays.log_scales[3 * row + k];
  g.opacity_logit = arrays.opacity_logits[row];
  return g;
}

}  // namespace ggslam::cuda
