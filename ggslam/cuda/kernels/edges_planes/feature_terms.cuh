// SPDX-License-Identifier: Apache-2.0
// What one feature contributes to an alignment: its distance to the plane or the line of the map that it is matched to
// (equation 3), with Huber's norm, as in ggslam/tracking/edges_planes/alignment.py.
#pragma once
#include "edges_planes/feature_picks.cuh"
#include "edges_planes/feature_table.cuh"

namespace ggslam::cuda {

// Sums over features: upper triangle of the 6x6 matrix row by row, right side, Huber's cost.
enum FeatureSum { kFeatureMatrix, kFeatureRight = kFeatureMatrix + 21, kFeatureCost = kFeatureRight + 6, kFeatureSums };

// Sums over the features at the pose found: see FeatureResult; moments are about the first feature, with the weights of
// the residuals.
enum FeatureReportSum {
  kSumInliers, kSumSquared, kSumWeight, kSumMoment1, kSumMoment2 = kSumMoment1 + 3, kFeatureReportSums = kSumMoment2 + 1
};

// How many features are aligned of those that a scan has.
struct AlignedCounts {
  int planes, edges;
};

__device__ inline AlignedCounts aligned_counts(const FeatureAlignJob& job) {
  return {min(job.scan.header->planes, job.limits.planes), min(job.scan.header->edges, job.limits.edges)};
}

// A feature that is aligned.
struct Feature {
  const float* point;
  float sigma, normal[3];
  bool edge;
};

__device__ inline Feature feature_of(const FeatureAlignJob& job, const AlignedCounts& counts, int i) {
  Feature f;
  f.edge = i >= counts.planes;
  const std::int64_t n = f.edge ? thinned(i - counts.planes, counts.edges, job.scan.header->edges)
                                : thinned(i, counts.planes, job.scan.header->planes);
  f.point = (f.edge ? job.scan.edges : job.scan.planes) + 3 * n;
  f.sigma = f.edge ? job.scan.edge_sigmas[n] : job.scan.plane_sigmas[n];
#pragma unroll
  for (int a = 0; a < 3; ++a) f.normal[a] = f.edge ? 0.0f : job.scan.normals[3 * n + a];
  return f;
}

// Distance of a point to a plane of the map, metres.
__device__ inline float plane_distance(const float* surface, const float (&p)[3]) {
  return (p[0] - surface[0]) * surface[3] + (p[1] - surface[1]) * surface[4] + (p[2] - surface[2]) * surface[5];
}

// Matches: -1 without one, else twice the slot, plus 1 if its residuals count.
__device__ inline std::int32_t kept_match(std::int32_t match) { return match >= 0 && (match & 1) ? match >> 1 : -1; }

// Matches a feature; how many residuals it has. Before the last matching the pose is not yet good, and outliers are told
// generously.
__device__ inline int match_feature(const FeatureAlignJob& job, const AlignedCounts& counts, const FloatPose& pose, int i,
                                    bool is_last) {
  const FeatureAlignLimits& limits = job.limits;
  const Feature f = feature_of(job, counts, i);
  float p[3], normal[3];
  place_point(pose, f.point, p);
  rotate(pose.rotation, f.normal, normal);
  const std::int32_t slot = find_surface(job.table, p, normal, f.edge);
  bool counted = slot >= 0;
  if (counted && !f.edge) {
    const float gate = (limits.gate_constant + limits.gate_sigmas * f.sigma) * (is_last ? 1.0f : 3.0f);
    counted = fabsf(plane_distance(job.table.surfaces + 8 * static_cast<std::int64_t>(slot), p)) < gate;
  }
  if (f.edge && limits.edge_weight == 0) counted = false;
  job.matches[i] = slot < 0 ? -1 : 2 * slot + counted;
  return counted ? (f.edge ? 2 : 1) : 0;
}

// Two unit vectors at right angles to a unit vector and to each other.
__device__ inline void across(const float (&direction)[3], float (&first)[3], float (&second)[3]) {
  const float x = direction[0], y = direction[1], z = direction[2];
  const bool steep = fabsf(z) > 0.7f;
  first[0] = steep ? 0.0f : y, first[1] = steep ? z : -x, first[2] = steep ? -y : 0.0f;
  const float length = sqrtf(first[0] * first[0] + first[1] * first[1] + first[2] * first[2]);
#pragma unroll
  for (int a = 0; a < 3; ++a) first[a] /= length;
  second[0] = y * first[2] - z * first[1], second[1] = z * first[0] - x * first[2], second[2] = x * first[1] - y * first[0];
}

// Inverse variance of a feature's residuals.
__device__ inline float residual_weight(const FeatureAlignJob& job, const Feature& f, const float* surface) {
  const float weight = 1.0f / (f.sigma * f.sigma + surface[6]);
  return f.edge ? weight * job.limits.edge_weight : weight;
}

// Adds factor * residual^2 of an axis to the normal equations, of a twist from the left about the sensor's centre: its
// derivatives are the axis and (R q) x axis.
__device__ inline void add_residual(const float (&turned)[3], const float (&axis)[3], float residual, float factor,
                                    float (&sums)[kFeatureSums]) {
  const float j[6] = {axis[0], axis[1], axis[2], turned[1] * axis[2] - turned[2] * axis[1],
                      turned[2] * axis[0] - turned[0] * axis[2], turned[0] * axis[1] - turned[1] * axis[0]};
  int k = 0;
#pragma unroll
  for (int a = 0; a < 6; ++a)
#pragma unroll
    for (int b = a; b < 6; ++b, ++k) sums[kFeatureMatrix + k] += factor * j[a] * j[b];
#pragma unroll
  for (int a = 0; a < 6; ++a) sums[kFeatureRight + a] += factor * residual * j[a];
}

// Normal equations of a feature.
__device__ inline void feature_terms(const FeatureAlignJob& job, const AlignedCounts& counts, const FloatPose& pose, int i,
                                     float (&sums)[kFeatureSums]) {
  const std::int32_t slot = kept_match(job.matches[i]);
  if (slot < 0) return;
  const Feature f = feature_of(job, counts, i);
  const float* surface = job.table.surfaces + 8 * static_cast<std::int64_t>(slot);
  const float weight = residual_weight(job, f, surface), root = sqrtf(weight);
  float turned[3], offset[3], first[3] = {surface[3], surface[4], surface[5]}, second[3] = {0, 0, 0};
  rotate(pose.rotation, f.point, turned);
#pragma unroll
  for (int a = 0; a < 3; ++a) offset[a] = turned[a] + pose.translation[a] - surface[a];
  if (f.edge) {
    const float direction[3] = {surface[3], surface[4], surface[5]};
    across(direction, first, second);
  }
  const float one = offset[0] * first[0] + offset[1] * first[1] + offset[2] * first[2];
  const float other = f.edge ? offset[0] * second[0] + offset[1] * second[1] + offset[2] * second[2] : 0.0f;
  const float size = fmaxf(root * (f.edge ? sqrtf(one * one + other * other) : fabsf(one)), 1e-12f);
  const float inner = fminf(size, job.limits.huber_sigmas), factor = weight * (inner / size);
  sums[kFeatureCost] += inner * (2 * size - inner);
  add_residual(turned, first, one, factor, sums);
  if (f.edge) add_residual(turned, second, other, factor, sums);
}

// What a feature says of the pose found.
__device__ inline void feature_report(const FeatureAlignJob& job, const AlignedCounts& counts, const FloatPose& pose, int i,
                                      float (&sums)[kFeatureReportSums]) {
  const std::int32_t match = job.matches[i];
  if (match < 0) return;
  const Feature f = feature_of(job, counts, i);
  const float* surface = job.table.surfaces + 8 * static_cast<std::int64_t>(match >> 1);
  if (!f.edge) {
    float p[3];
    place_point(pose, f.point, p);
    const float distance = fabsf(plane_distance(surface, p));
    if (distance < job.limits.overlap_constant + job.limits.overlap_sigmas * f.sigma)
      sums[kSumInliers] += 1, sums[kSumSquared] += distance * distance;
  }
  if (!(match & 1)) return;
  const float* origin = feature_of(job, counts, 0).point;
  const float weight = residual_weight(job, f, surface) * (f.edge ? 2.0f : 1.0f);  // of both residuals of an edge
  sums[kSumWeight] += weight;
#pragma unroll
  for (int a = 0; a < 3; ++a) {
    const float from_first = f.point[a] - origin[a];
    sums[kSumMoment1 + a] += weight * from_first;
    sums[kSumMoment2] += weight * from_first * from_first;
  }
}

}  // namespace ggslam::cuda
