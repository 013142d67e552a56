// SPDX-License-Identifier: Apache-2.0
// Generalised ICP (Segal et al., RSS 2009): nearest voxels and normal equations of a block of points.
//
// The pose changes by a twist (v, w) in world axes about the camera centre c: p' = p + v + w x (p - c). With
// d = mean - p and M = (C_voxel + R C_point R^T)^-1 the cost of a match is weight rho(r^2), r^2 = plane_variance d^T M d,
// which for two planes is the squared distance along their normal; rho is Geman-McClure's g r^2 / (g + r^2).
#include <limits>

#include "native/formulas/gicp_terms.hpp"
#include "tracking/kernels/voxel_lookup.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

constexpr float kSearchAgain = 0.02f;  // of a voxel's edge

struct Pose {
  const float* r;  // row by row
  const float* t;
  void rotate(const float* v, float* out) const {
    for (int i = 0; i < 3; ++i) out[i] = r[3 * i] * v[0] + r[3 * i + 1] * v[1] + r[3 * i + 2] * v[2];
  }
};

// Index of the voxel whose mean is nearest to p, not farther than a voxel's edge, and whose normal agrees; or -1.
int nearest_voxel(const VoxelLevelView& level, const float p[3], const float normal[3], float min_dot) {
  int best = -1;
  float nearest = level.size * level.size;
  visit_neighbourhood(level, voxel_coordinate(p[0], level.inverse_size), voxel_coordinate(p[1], level.inverse_size),
                      voxel_coordinate(p[2], level.inverse_size), [&](int index) {
    const Voxel& v = level.voxels[index];
    const float dx = v.mean[0] - p[0], dy = v.mean[1] - p[1], dz = v.mean[2] - p[2];
    const float distance = dx * dx + dy * dy + dz * dz;
    if (distance < nearest && v.normal[0] * normal[0] + v.normal[1] * normal[1] + v.normal[2] * normal[2] > min_dot) {
      nearest = distance;
      best = index;
    }
  });
  return best;
}

float depth_of(const AlignPoints& points, std::size_t i) {
  return points.depths ? points.depths[i] : points.points[3 * i + 2];
}

// Whether the point has moved so far since its match was found that another voxel may be nearer by more than a trifle;
// notes the place if so. The last iterations move points by micrometres and need no search.
bool must_search(const LinearizeArgs& args, std::size_t i, const float p[3]) {
  if (!args.searched_at) return true;
  float* at = args.searched_at + 3 * i;
  const float dx = p[0] - at[0], dy = p[1] - at[1], dz = p[2] - at[2];
  const float limit = kSearchAgain * args.level.size;
  if (dx * dx + dy * dy + dz * dz < limit * limit) return false;  // false for NaN, too
  for (int a = 0; a < 3; ++a) at[a] = p[a];
  return true;
}

}  // namespace

// Matches the points begin, begin + point_step, ... < end and sums up their normal equations.
void linearize_block(const LinearizeArgs& args, std::size_t begin, std::size_t end, AlignSums* sums) {
  const AlignSettings& s = args.settings;
  const Pose pose{args.rotation, args.translation};
  float h[21] = {0}, b[6] = {0}, cost = 0;
  int matches = 0;
  for (std::size_t i = begin; i < end; i += args.point_step) {
    float q[3], p[3], n[3], d[3], m[6];
    pose.rotate(args.points.points + 3 * i, q);
    pose.rotate(args.points.normals + 3 * i, n);
    for (int a = 0; a < 3; ++a) p[a] = q[a] + pose.t[a];
    const float depth = depth_of(args.points, i);
    const float sigma = s.noise_constant + s.noise_square * depth * depth;
    const float width = args.kernel_factor * (s.kernel_constant + s.kernel_sigmas * sigma), g = width * width;
    const float weight = args.points.weights[i];
    if (must_search(args, i, p)) args.match[i] = nearest_voxel(args.level, p, n, s.min_normal_dot);
    const int match = args.match[i];
    if (match < 0) {
      cost += weight * g;  // the kernel's limit, so that losing a match never looks like an improvement
      args.squared_distance[i] = std::numeric_limits<float>::infinity();
      continue;
    }
    const Voxel& v = args.level.voxels[match];
    for (int a = 0; a < 3; ++a) d[a] = v.mean[a] - p[a];
    const float plane = d[0] * v.normal[0] + d[1] * v.normal[1] + d[2] * v.normal[2];
    args.squared_distance[i] = plane * plane;
    match_precision(v.covariance, args.points.covariances + 6 * i, args.rotation, m);
    const float squared = s.plane_variance * (d[0] * (m[0] * d[0] + 2 * (m[1] * d[1] + m[2] * d[2])) +
                                              d[1] * (m[3] * d[1] + 2 * m[4] * d[2]) + d[2] * m[5] * d[2]);
    const float ratio = g / (g + squared);
    cost += weight * ratio * squared;
    ++matches;
    const float factor = weight * ratio * ratio * s.plane_variance;
    for (float& value : m) value *= factor;
    add_normal_equations(m, q, d, h, b);
  }
  for (int k = 0; k < 21; ++k) sums->h[k] = h[k];
  for (int k = 0; k < 6; ++k) sums->b[k] = b[k];
  sums->cost = cost;
  sums->matches = matches;
}

// What the matches of the last linearisation say about the pose: information of the distances along the voxels'
// normals, each with the standard deviation of its depth and the robust weight, and the inliers.
void plane_information_block(const LinearizeArgs& args, std::size_t begin, std::size_t end, PlaneSums* sums) {
  const AlignSettings& s = args.settings;
  const Pose pose{args.rotation, args.translation};
  double information[21] = {0}, squared = 0;
  int inliers = 0;
  for (std::size_t i = begin; i < end; i += args.point_step) {
    if (args.match[i] < 0) continue;
    const float depth = depth_of(args.points, i);
    const float sigma = s.noise_constant + s.noise_square * depth * depth;
    const float limit = s.overlap_constant + s.overlap_sigmas * sigma;
    if (args.squared_distance[i] < limit * limit) {
      ++inliers;
      squared += args.squared_distance[i];
    }
    const float width = s.kernel_constant + s.kernel_sigmas * sigma, g = width * width;
    const float ratio = g / (g + args.squared_distance[i]);
    const float factor = ratio * ratio / (sigma * sigma);
    const float* n = args.level.voxels[args.match[i]].normal;
    float q[3];
    pose.rotate(args.points.points + 3 * i, q);
    const float j[6] = {n[0], n[1], n[2], q[1] * n[2] - q[2] * n[1], q[2] * n[0] - q[0] * n[2], q[0] * n[1] - q[1] * n[0]};
    int k = 0;
    for (int a = 0; a < 6; ++a)
      for (int c = a; c < 6; ++c, ++k) information[k] += factor * j[a] * j[c];
  }
  for (int k = 0; k < 21; ++k) sums->information[k] = information[k];
  sums->inliers = inliers;
  sums->squared = squared;
}

}  // namespace ggslam::GGSLAM_ISA
