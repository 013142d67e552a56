// SPDX-License-Identifier: Apache-2.0
// What one textured point contributes to an alignment: its grey value against a reference image, as in
// native/src/tracking/kernels/photometric.cpp, where the equations are stated.
#pragma once
#include "tracking/point_terms.cuh"

namespace ggslam::cuda {

// Sums over points: upper triangle of the 8x8 matrix (twist, gain, bias) row by row, right side, and the rest.
enum GreySum { kGreyMatrix, kGreyRight = kGreyMatrix + 36, kGreyCost = kGreyRight + 8, kGreyCount, kGreyAbsolute, kGreySums };

struct GreySample {
  float grey, du, dv, depth;
};

// Bilinear sample; false outside the image. The depth is the nearest pixel's: the mean across an edge belongs to neither
// surface.
__device__ inline bool sample_reference(const PhotometricReferenceView& r, float u, float v, GreySample* out) {
  if (!(u >= 0 && v >= 0 && u < r.width - 1 && v < r.height - 1)) return false;
  const int x = static_cast<int>(u), y = static_cast<int>(v);
  const float fx = u - x, fy = v - y;
  const float4* a = reinterpret_cast<const float4*>(r.pixels) + (static_cast<std::int64_t>(y) * r.width + x);
  const float4 a0 = a[0], a1 = a[1], b0 = a[r.width], b1 = a[r.width + 1];
  out->grey = (1 - fy) * ((1 - fx) * a0.x + fx * a1.x) + fy * ((1 - fx) * b0.x + fx * b1.x);
  out->du = (1 - fy) * ((1 - fx) * a0.y + fx * a1.y) + fy * ((1 - fx) * b0.y + fx * b1.y);
  out->dv = (1 - fy) * ((1 - fx) * a0.z + fx * a1.z) + fy * ((1 - fx) * b0.z + fx * b1.z);
  out->depth = fy < 0.5f ? (fx < 0.5f ? a0.w : a1.w) : (fx < 0.5f ? b0.w : b1.w);
  return true;
}

// Normal equations of textured point i.
__device__ inline void photometric_terms(const AlignJob& job, const FloatPose& pose, float gain, float bias, int i,
                                         float (&sums)[kGreySums]) {
  const PhotometricReferenceView& ref = job.reference;
  const AlignSettings& s = job.settings;
  float q[3], w[3], x[3];
  rotate(pose.rotation, job.photometric_points.points + 3 * static_cast<std::int64_t>(i), q);
#pragma unroll
  for (int a = 0; a < 3; ++a) w[a] = q[a] + pose.translation[a];
  rotate(ref.rotation, w, x);
#pragma unroll
  for (int a = 0; a < 3; ++a) x[a] += ref.translation[a];
  if (x[2] < 0.05f) return;
  const float inverse_z = 1 / x[2];
  GreySample at;
  if (!sample_reference(ref, ref.fx * x[0] * inverse_z + ref.cx, ref.fy * x[1] * inverse_z + ref.cy, &at)) return;
  if (at.depth > 0 && fabsf(at.depth - x[2]) > s.depth_tolerance * x[2]) return;  // occluded or disoccluded
  const float intensity = job.photometric_points.intensity[i];
  const float residual = at.grey - (gain * intensity + bias), size = fabsf(residual);
  const float weight = size <= s.huber ? 1 : s.huber / size;
  sums[kGreyCost] = size <= s.huber ? residual * residual : s.huber * (2 * size - s.huber);
  sums[kGreyAbsolute] = size;
  sums[kGreyCount] = 1;
  const float gx = at.du * ref.fx * inverse_z, gy = at.dv * ref.fy * inverse_z;
  const float g[3] = {gx, gy, -(gx * x[0] + gy * x[1]) * inverse_z};
  float gw[3];
#pragma unroll
  for (int a = 0; a < 3; ++a) gw[a] = ref.rotation[a] * g[0] + ref.rotation[3 + a] * g[1] + ref.rotation[6 + a] * g[2];
  const float j[8] = {gw[0], gw[1], gw[2], q[1] * gw[2] - q[2] * gw[1], q[2] * gw[0] - q[0] * gw[2],
                      q[0] * gw[1] - q[1] * gw[0], -intensity, -1};
  int k = 0;
#pragma unroll
  for (int a = 0; a < 8; ++a) {
    const float wj = weight * j[a];
    sums[kGreyRight + a] = -wj * residual;
#pragma unroll
    for (int c = a; c < 8; ++c, ++k) sums[kGreyMatrix + k] = wj * j[c];
  }
}

}  // namespace ggslam::cuda
