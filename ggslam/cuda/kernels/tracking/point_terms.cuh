// SPDX-License-Identifier: Apache-2.0
// What one point contributes to an alignment: Generalised ICP (Segal et al., RSS 2009) with a Geman-McClure kernel, as in
// native/src/tracking/kernels/gicp.cpp, where the equations are stated.
#pragma once
#include "native/formulas/gicp_terms.hpp"
#include "tracking/rigid_motion.cuh"
#include "tracking/voxel_lookup.cuh"

namespace ggslam::cuda {

constexpr float kSearchAgain = 0.02f;  // of a voxel's edge

// Sums over points; the first 27 are the upper triangle of the 6x6 matrix row by row, and the right side.
enum AlignSum { kMatrix, kRight = kMatrix + 21, kCostSum = kRight + 6, kMatches, kWeight, kAlignSums };

// Sums over points at the pose found: information as above, and moments of the points about the first one, each weighed
// by 1 / sigma(z)^2.
enum ReportSum {
  kPlanes,
  kInliers = kPlanes + 21,
  kSquared, kReportCost, kReportMatches, kReportWeight,
  kMoment0, kMoment1, kMoment2 = kMoment1 + 3,
  kReportSums
};

// A point at a pose, and the voxel it is matched to.
struct PlacedPoint {
  float q[3], p[3];  // turned; turned and shifted
  float sigma, weight;
  int match;
};

// Places point i and finds its match, unless it has moved so little since its match was found that another voxel cannot
// be nearer by more than a trifle. `fresh`: at this level nothing was matched yet.
__device__ inline PlacedPoint place_point(const AlignJob& job, const VoxelLevel& level, const FloatPose& pose,
                                          float* searched_at, int i, bool fresh) {
  const AlignSettings& s = job.settings;
  const float* point = job.points.points + 3 * static_cast<std::int64_t>(i);
  PlacedPoint at;
  rotate(pose.rotation, point, at.q);
#pragma unroll
  for (int a = 0; a < 3; ++a) at.p[a] = at.q[a] + pose.translation[a];
  at.sigma = s.noise_constant + s.noise_square * point[2] * point[2];
  at.weight = job.points.weights[i];
  float* searched = searched_at + 3 * static_cast<std::int64_t>(i);
  bool search = fresh;
  if (!fresh) {
    const float dx = at.p[0] - searched[0], dy = at.p[1] - searched[1], dz = at.p[2] - searched[2];
    const float limit = kSearchAgain * level.size;
    search = !(dx * dx + dy * dy + dz * dz < limit * limit);
  }
  if (search) {
    float normal[3];
    rotate(pose.rotation, job.points.normals + 3 * static_cast<std::int64_t>(i), normal);
    at.match = nearest_voxel(level, at.p, normal, s.min_normal_dot);
    job.match[i] = at.match;
#pragma unroll
    for (int a = 0; a < 3; ++a) searched[a] = at.p[a];
  } else {
    at.match = job.match[i];
  }
  return at;
}

// The match's weighted cost; fills d = mean - p and M, scaled by all weights.
__device__ inline float match_cost(const AlignJob& job, const Voxel& voxel, const FloatPose& pose, int i,
                                   const PlacedPoint& at, float kernel_factor, float (&m)[6], float (&d)[3]) {
  const AlignSettings& s = job.settings;
  const float width = kernel_factor * (s.kernel_constant + s.kernel_sigmas * at.sigma), g = width * width;
#pragma unroll
  for (int a = 0; a < 3; ++a) d[a] = voxel.mean[a] - at.p[a];
  match_precision(voxel.covariance, job.points.covariances + 6 * static_cast<std::int64_t>(i), pose.rotation, m);
  const float squared = s.plane_variance * (d[0] * (m[0] * d[0] + 2 * (m[1] * d[1] + m[2] * d[2])) +
                                            d[1] * (m[3] * d[1] + 2 * m[4] * d[2]) + d[2] * m[5] * d[2]);
  const float ratio = g / (g + squared), factor = at.weight * ratio * ratio * s.plane_variance;
#pragma unroll
  for (int k = 0; k < 6; ++k) m[k] *= factor;
  return at.weight * ratio * squared;
}

// What a point without match costs: the kernel's limit, so that losing a match never looks like an improvement.
__device__ inline float lost_cost(const AlignSettings& s, const PlacedPoint& at, float kernel_factor) {
  const float width = kernel_factor * (s.kernel_constant + s.kernel_sigmas * at.sigma);
  return at.weight * width * width;
}

// Normal equations of point i.
__device__ inline void align_terms(const AlignJob& job, const VoxelLevel& level, const FloatPose& pose,
                                   float* searched_at, int i, bool fresh, float kernel_factor,
                                   float (&sums)[kAlignSums]) {
  const PlacedPoint at = place_point(job, level, pose, searched_at, i, fresh);
  sums[kWeight] = at.weight;
  if (at.match < 0) {
    sums[kCostSum] = lost_cost(job.settings, at, kernel_factor);
    return;
  }
  float m[6], d[3];
  sums[kCostSum] = match_cost(job, level.voxels[at.match], pose, i, at, kernel_factor, m, d);
  sums[kMatches] = 1;
  add_normal_equations(m, at.q, d, sums + kMatrix, sums + kRight);
}

// What point i's match says about the pose found: information of its distance along the voxel's normal, with the standard
// deviation of its depth and the robust weight; and where the point lies.
__device__ inline void report_terms(const AlignJob& job, const FloatPose& pose, float* searched_at, int i,
                                    float (&sums)[kReportSums]) {
  const AlignSettings& s = job.settings;
  const PlacedPoint at = place_point(job, job.fine, pose, searched_at, i, false);
  const float* point = job.points.points + 3 * static_cast<std::int64_t>(i);
  const float inverse_variance = 1 / (at.sigma * at.sigma);
  sums[kReportWeight] = at.weight;
  sums[kMoment0] = inverse_variance;
#pragma unroll
  for (int a = 0; a < 3; ++a) {
    const float from_first = point[a] - job.points.points[a];
    sums[kMoment1 + a] = inverse_variance * from_first;
    sums[kMoment2] += inverse_variance * from_first * from_first;
  }
  if (at.match < 0) {
    sums[kReportCost] = lost_cost(s, at, 1);
    job.squared_distance[i] = __uint_as_float(0x7f800000u);  // infinity
    return;
  }
  const Voxel& voxel = job.fine.voxels[at.match];
  float m[6], d[3];
  sums[kReportCost] = match_cost(job, voxel, pose, i, at, 1, m, d);
  sums[kReportMatches] = 1;
  const float n[3] = {voxel.normal[0], voxel.normal[1], voxel.normal[2]};
  const float plane = d[0] * n[0] + d[1] * n[1] + d[2] * n[2], squared = plane * plane;
  job.squared_distance[i] = squared;
  const float limit = s.overlap_constant + s.overlap_sigmas * at.sigma;
  if (squared < limit * limit) sums[kInliers] = 1, sums[kSquared] = squared;
  const float width = s.kernel_constant + s.kernel_sigmas * at.sigma, g = width * width, ratio = g / (g + squared);
  const float factor = ratio * ratio * inverse_variance;
  const float j[6] = {n[0], n[1], n[2], at.q[1] * n[2] - at.q[2] * n[1], at.q[2] * n[0] - at.q[0] * n[2],
                      at.q[0] * n[1] - at.q[1] * n[0]};
  int k = 0;
#pragma unroll
  for (int a = 0; a < 6; ++a)
#pragma unroll
    for (int c = a; c < 6; ++c, ++k) sums[kPlanes + k] = factor * j[a] * j[c];
}

}  // namespace ggslam::cuda
