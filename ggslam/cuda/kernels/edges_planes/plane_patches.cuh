// SPDX-License-Identifier: Apache-2.0
// Planes fitted to 5 x 5 pixels of a depth image: the rules of DepthImageFeatures in
// ggslam/tracking/edges_planes/scans.py. In a pinhole image 1/z of a plane is linear in column and row.
#pragma once
#include "edges_planes/scan_lines.cuh"

namespace ggslam::cuda {

constexpr int kPatchHalf = 2;
constexpr int kPatchSide = 2 * kPatchHalf + 1, kPatchPixels = kPatchSide * kPatchSide;

struct PlanePatch {
  float point[3], normal[3], z;
};

// 1/z as a + b column + c row about a pixel, and the standard deviation of what is left.
struct DepthFit {
  float middle, per_column, per_row, left;
};

__device__ inline DepthFit fit_inverse_depth(const FeatureScanJob& job, int u, int v) {
  const FeatureSettings& s = job.settings;
  const float* depth = depth_of(job);
  float inverse[kPatchPixels], columns = 0, rows = 0, sum = 0, squares = 0;
#pragma unroll
  for (int k = 0; k < kPatchPixels; ++k) {
    const int du = (k % kPatchSide - kPatchHalf) * s.patch_step, dv = (k / kPatchSide - kPatchHalf) * s.patch_step;
    inverse[k] = 1.0f / depth[static_cast<std::int64_t>(v + dv) * s.width + u + du];  // infinite where unknown
    columns += static_cast<float>(du) * inverse[k], rows += static_cast<float>(dv) * inverse[k], sum += inverse[k];
    squares += static_cast<float>(du * du);
  }
  const DepthFit fit{sum / kPatchPixels, columns / squares, rows / squares, 0};
  float left = 0;
#pragma unroll
  for (int k = 0; k < kPatchPixels; ++k) {
    const float du = static_cast<float>((k % kPatchSide - kPatchHalf) * s.patch_step);
    const float dv = static_cast<float>((k / kPatchSide - kPatchHalf) * s.patch_step);
    const float off = inverse[k] - (du * fit.per_column + dv * fit.per_row + fit.middle);
    left += off * off;
  }
  return {fit.middle, fit.per_column, fit.per_row, sqrtf(left / (kPatchPixels - 3))};
}

// The plane about a pixel; false if it lies on none.
__device__ inline bool fit_patch(const FeatureScanJob& job, PixelPlace at, PlanePatch& patch) {
  const FeatureSettings& s = job.settings;
  const int margin = kPatchHalf * s.patch_step;
  if (at.u < margin || at.u >= s.width - margin || at.v < margin || at.v >= s.height - margin) return false;
  const DepthFit fit = fit_inverse_depth(job, at.u, at.v);
  const float z = 1.0f / fit.middle, x = ray_x(s, at.u), y = ray_y(s, at.v);
  const float a = fit.per_column * s.fx, b = fit.per_row * s.fy, c = fit.middle - a * x - b * y;
  const float length = sqrtf(a * a + b * b + c * c);  // the plane's normal over its distance
  const float cosine = fit.middle / (length * sqrtf(x * x + y * y + 1.0f));
  const float limit = s.plane_sigmas * feature_sigma(s, z) + s.roughness * z;
  patch.z = z;
  patch.point[0] = x * z, patch.point[1] = y * z, patch.point[2] = z;
  patch.normal[0] = a / -length, patch.normal[1] = b / -length, patch.normal[2] = c / -length;
  return fit.left * z * z < limit && cosine > s.min_cosine;  // false for what is not a number
}

}  // namespace ggslam::cuda
