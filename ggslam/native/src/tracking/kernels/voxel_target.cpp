// SPDX-License-Identifier: Apache-2.0
// Gaussians gathered in voxels: where each belongs, what its voxel learns from it, and the voxel's final shape.
#include "native/formulas/symmetric3.hpp"
#include "tracking/kernels/voxel_lookup.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

struct MemberShape {
  float weight;      // opacity over area
  float thickness;   // regularised
  float normal[3];
  float covariance[6];
  bool oriented;     // whether the sign of the normal means something
};

// Rows of the transposed rotation matrix: axes[i] is the direction of scale i.
void quaternion_axes(const float* q, float axes[3][3]) {
  const float norm = 2 / (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] + 1e-30f);
  const float w = q[0], x = q[1], y = q[2], z = q[3];
  axes[0][0] = 1 - norm * (y * y + z * z), axes[0][1] = norm * (x * y + w * z), axes[0][2] = norm * (x * z - w * y);
  axes[1][0] = norm * (x * y - w * z), axes[1][1] = 1 - norm * (x * x + z * z), axes[1][2] = norm * (y * z + w * x);
  axes[2][0] = norm * (x * z + w * y), axes[2][1] = norm * (y * z - w * x), axes[2][2] = 1 - norm * (x * x + y * y);
}

// A Gaussian's regularised covariance and its normal: the direction of its smallest scale. Discs are born with their
// third axis along the normal towards the camera and training turns them continuously, so the third axis keeps its
// sign; the camera's position settles the sign in any case.
MemberShape member_shape(const TargetInput& in, const TargetSettings& s, int g) {
  const float* log_scale = in.log_scales + 3 * g;
  int order[3] = {0, 1, 2};
  if (log_scale[order[0]] < log_scale[order[1]]) std::swap(order[0], order[1]);
  if (log_scale[order[1]] < log_scale[order[2]]) std::swap(order[1], order[2]);
  if (log_scale[order[0]] < log_scale[order[1]]) std::swap(order[0], order[1]);
  float variance[3], axes[3][3], sorted[3][3], shape[3];
  for (int i = 0; i < 3; ++i) variance[i] = std::exp(2 * log_scale[order[i]]);
  quaternion_axes(in.quaternions + 4 * g, axes);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) sorted[i][j] = axes[order[i]][j];
  regularized_axes(variance, s.min_thickness, 1.0f, s.max_elongation, shape);
  MemberShape m;
  compose_symmetric3(shape, sorted, m.covariance);
  m.thickness = shape[2];
  // Small Gaussians were seen from near (or trained to fine detail): their means are known better. The floor keeps
  // one vanishing Gaussian from outweighing its voxel.
  const float floor = 0.01f * s.voxel * s.voxel;
  const float opacity = 1 / (1 + std::exp(-in.opacity_logits[g]));
  m.weight = opacity * s.voxel * s.voxel / (variance[1] + floor);
  for (int i = 0; i < 3; ++i) m.normal[i] = sorted[2][i];
  m.oriented = order[2] == 2;
  const int camera = in.birth && in.cameras > 0 ? in.birth[g] : -1;
  if (camera >= 0 && camera < in.cameras) {
    float facing = 0;
    for (int i = 0; i < 3; ++i) facing += m.normal[i] * (in.camera_positions[3 * camera + i] - in.means[3 * g + i]);
    if (facing < 0)
      for (float& n : m.normal) n = -n;
    m.oriented = true;
  }
  return m;
}

}  // namespace

// Block key of each Gaussian in [begin, end) and its bit in the block; kEmptyKey for those that take no part.
void bin_gaussians(const TargetInput& in, const TargetSettings& s, std::size_t begin, std::size_t end, uint64_t* keys,
                   uint8_t* bits) {
  const float inverse = 1 / s.voxel, reach = 4.0e6f;  // 2^20 blocks of 4 voxels
  for (std::size_t g = begin; g < end; ++g) {
    const float x = in.means[3 * g] * inverse, y = in.means[3 * g + 1] * inverse, z = in.means[3 * g + 2] * inverse;
    // Sums, because a NaN in any term makes the comparison false.
    const float extent = std::fabs(x) + std::fabs(y) + std::fabs(z);
    const float *q = in.quaternions + 4 * g, *l = in.log_scales + 3 * g;
    const float length = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
    const float scales = std::fabs(l[0]) + std::fabs(l[1]) + std::fabs(l[2]);
    if (!(in.opacity_logits[g] >= s.min_opacity_logit) || !(extent < reach) || !(scales < 40) ||
        !(length > 1e-12f && length < 1e12f)) {
      keys[g] = kEmptyKey;
      continue;
    }
    const int i = static_cast<int>(std::floor(x)), j = static_cast<int>(std::floor(y)), k = static_cast<int>(std::floor(z));
    keys[g] = block_key(i >> 2, j >> 2, k >> 2);
    bits[g] = static_cast<uint8_t>((i & 3) + 4 * (j & 3) + 16 * (k & 3));
  }
}

// Adds Gaussians to the moments of their voxels, in the order given.
void accumulate_members(const TargetInput& in, const TargetSettings& s, const int32_t* members, const int32_t* voxels,
                        std::size_t count, VoxelMoments* moments) {
  for (std::size_t i = 0; i < count; ++i) {
    const int g = members[i];
    VoxelMoments& v = moments[voxels[i]];
    MemberShape m = member_shape(in, s, g);
    const float agreement = m.normal[0] * v.normal[0] + m.normal[1] * v.normal[1] + m.normal[2] * v.normal[2];
    if (agreement < 0) {
      if (m.oriented) continue;  // the back of a thin sheet: the side seen first stays
      for (float& n : m.normal) n = -n;
    }
    float d[3];
    for (int a = 0; a < 3; ++a) d[a] = in.means[3 * g + a] - v.centre[a];
    v.weight += m.weight;
    int k = 0;
    for (int a = 0; a < 3; ++a) {
      v.offset[a] += m.weight * d[a];
      v.normal[a] += m.weight * (1.001f - m.thickness) * m.normal[a];
      for (int b = a; b < 3; ++b, ++k) {
        v.outer[k] += m.weight * d[a] * d[b];
        v.own[k] += m.weight * m.covariance[k];
      }
    }
  }
}

// Sum of the moments of some voxels about the centre of the first; used for the coarse level.
void merge_moments(const VoxelMoments* parts, std::size_t count, VoxelMoments* sum) {
  for (std::size_t i = 0; i < count; ++i) {
    const VoxelMoments& p = parts[i];
    float facing = 0, d[3];
    for (int a = 0; a < 3; ++a) facing += p.normal[a] * sum->normal[a], d[a] = p.centre[a] - sum->centre[a];
    if (facing < 0) continue;
    sum->weight += p.weight;
    int k = 0;
    for (int a = 0; a < 3; ++a)
      for (int b = a; b < 3; ++b, ++k) {
        sum->outer[k] += p.outer[k] + d[a] * p.offset[b] + d[b] * p.offset[a] + p.weight * d[a] * d[b];
        sum->own[k] += p.own[k];
      }
    for (int a = 0; a < 3; ++a) sum->offset[a] += p.offset[a] + p.weight * d[a], sum->normal[a] += p.normal[a];
  }
}

namespace {

// Scatter of the means in the voxel and, with less weight, in its neighbours with a like normal, about the mean of
// all; in units of the variance of a plane that fills a voxel.
void neighbourhood_scatter(const TargetSettings& s, const VoxelLevelView& level, const VoxelMoments* moments,
                           const VoxelMoments& own, float scatter[6]) {
  float weight = 0, sum[3] = {0, 0, 0}, outer[6] = {0, 0, 0, 0, 0, 0};
  const auto add = [&](const VoxelMoments& m, float factor) {
    float d[3];
    for (int a = 0; a < 3; ++a) d[a] = m.centre[a] - own.centre[a];
    int k = 0;
    for (int a = 0; a < 3; ++a)
      for (int b = a; b < 3; ++b, ++k)
        outer[k] += factor * (m.outer[k] + d[a] * m.offset[b] + d[b] * m.offset[a] + m.weight * d[a] * d[b]);
    for (int a = 0; a < 3; ++a) sum[a] += factor * (m.offset[a] + m.weight * d[a]);
    weight += factor * m.weight;
  };
  add(own, 1.0f);
  if (s.neighbour_weight > 0) {
    const float* n = own.normal;
    const float length = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
    int c[3];
    for (int a = 0; a < 3; ++a) c[a] = voxel_coordinate(own.centre[a], level.inverse_size);
    visit_neighbourhood(level, c[0], c[1], c[2], [&](int index) {
      const VoxelMoments& m = moments[index];
      const float dot = m.normal[0] * n[0] + m.normal[1] * n[1] + m.normal[2] * n[2];
      const float other = m.normal[0] * m.normal[0] + m.normal[1] * m.normal[1] + m.normal[2] * m.normal[2];
      if (&m != &own && dot > 0 && dot * dot > 0.8f * length * other) add(m, s.neighbour_weight);
    });
  }
  const float f = 1 / weight, unit = 12 / (level.size * level.size);
  int k = 0;
  for (int a = 0; a < 3; ++a)
    for (int b = a; b < 3; ++b, ++k) scatter[k] = unit * (f * outer[k] - f * f * sum[a] * sum[b]);
}

}  // namespace

// Means, normals and regularised covariances of the voxels [begin, end).
void finish_voxels(const TargetSettings& s, const VoxelLevelView& level, const VoxelMoments* moments,
                   std::size_t begin, std::size_t end, Voxel* out) {
  for (std::size_t i = begin; i < end; ++i) {
    const VoxelMoments& m = moments[i];
    Voxel& v = out[i];
    float raw[6] = {0, 0, 0, 0, 0, 0}, values[3], axes[3][3], shape[3];
    if (s.scatter_weight > 0) neighbourhood_scatter(s, level, moments, m, raw);
    const float f = 1 / m.weight;
    for (int k = 0; k < 6; ++k) raw[k] = s.scatter_weight * raw[k] + f * m.own[k];
    eigen_symmetric3(raw, values, axes);
    regularized_axes(values, s.min_thickness, s.max_thickness, s.max_elongation, shape);
    compose_symmetric3(shape, axes, v.covariance);
    const float facing = axes[2][0] * m.normal[0] + axes[2][1] * m.normal[1] + axes[2][2] * m.normal[2];
    for (int a = 0; a < 3; ++a) {
      v.mean[a] = m.centre[a] + f * m.offset[a];
      v.normal[a] = facing < 0 ? -axes[2][a] : axes[2][a];
    }
    v.weight = m.weight;
    v.reserved = v.padding[0] = v.padding[1] = 0;
  }
}

}  // namespace ggslam::GGSLAM_ISA
