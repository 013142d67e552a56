// SPDX-License-Identifier: Apache-2.0
// Means, normals and covariances of a target's voxels from the moments of their members, as in
// native/src/tracking/kernels/voxel_target.cpp.
#pragma once
#include "native/formulas/symmetric3.hpp"
#include "tracking/voxel_lookup.cuh"

namespace ggslam::cuda {

constexpr int kFinishThreads = 128;

// Sums of some voxels' moments about one centre.
struct ScatterSums {
  float weight, sum[3], outer[6];
};

__device__ inline void add_moments(const VoxelMoments& m, const float (&centre)[3], float factor, ScatterSums& sums) {
  float d[3];
#pragma unroll
  for (int a = 0; a < 3; ++a) d[a] = m.centre[a] - centre[a];
  int k = 0;
#pragma unroll
  for (int a = 0; a < 3; ++a) {
#pragma unroll
    for (int b = a; b < 3; ++b, ++k)
      sums.outer[k] += factor * (m.outer[k] + d[a] * m.offset[b] + d[b] * m.offset[a] + m.weight * d[a] * d[b]);
    sums.sum[a] += factor * (m.offset[a] + m.weight * d[a]);
  }
  sums.weight += factor * m.weight;
}

// Scatter of the means in voxel i and, with less weight, in its neighbours with a like normal, about the mean of all; in
// units of the variance of a plane that fills a voxel.
__device__ inline void neighbourhood_scatter(const VoxelLevelJob& job, int i, const float (&centre)[3],
                                             const float (&n)[3], float (&scatter)[6]) {
  ScatterSums sums = {0, {0, 0, 0}, {0, 0, 0, 0, 0, 0}};
  add_moments(job.moments[i], centre, 1.0f, sums);
  if (job.settings.neighbour_weight > 0) {
    const float length = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
    int low[3];
    neighbourhood_of(job.level, centre, low);
    visit_neighbourhood(job.level, low, [&](int index) {
      const VoxelMoments& m = job.moments[index];
      const float dot = m.normal[0] * n[0] + m.normal[1] * n[1] + m.normal[2] * n[2];
      const float other = m.normal[0] * m.normal[0] + m.normal[1] * m.normal[1] + m.normal[2] * m.normal[2];
      if (index != i && dot > 0 && dot * dot > 0.8f * length * other)
        add_moments(m, centre, job.settings.neighbour_weight, sums);
    });
  }
  const float f = 1 / sums.weight, unit = 12 / (job.level.size * job.level.size);
  int k = 0;
#pragma unroll
  for (int a = 0; a < 3; ++a)
#pragma unroll
    for (int b = a; b < 3; ++b, ++k) scatter[k] = unit * (f * sums.outer[k] - f * f * sums.sum[a] * sums.sum[b]);
}

// One voxel per thread, of those that changed. Table and moments are as they will be.
__global__ void __launch_bounds__(kFinishThreads, 6) finish_voxels_kernel(VoxelLevelJob job) {
  const int thread = static_cast<int>(blockIdx.x * kFinishThreads + threadIdx.x);
  if (thread >= job.voxel_count) return;
  const int i = job.indices[thread];
  const TargetSettings& s = job.settings;
  const VoxelMoments& m = job.moments[i];
  const float centre[3] = {m.centre[0], m.centre[1], m.centre[2]}, normal[3] = {m.normal[0], m.normal[1], m.normal[2]};
  float raw[6] = {0, 0, 0, 0, 0, 0}, values[3], axes[3][3], shape[3];
  if (s.scatter_weight > 0) neighbourhood_scatter(job, i, centre, normal, raw);
  const float f = 1 / m.weight;
#pragma unroll
  for (int k = 0; k < 6; ++k) raw[k] = s.scatter_weight * raw[k] + f * m.own[k];
  eigen_symmetric3(raw, values, axes);
  regularized_axes(values, s.min_thickness, s.max_thickness, s.max_elongation, shape);
  Voxel v;
  compose_symmetric3(shape, axes, v.covariance);
  const float facing = axes[2][0] * normal[0] + axes[2][1] * normal[1] + axes[2][2] * normal[2];
#pragma unroll
  for (int a = 0; a < 3; ++a) {
    v.mean[a] = centre[a] + f * m.offset[a];
    v.normal[a] = facing < 0 ? -axes[2][a] : axes[2][a];
  }
  v.weight = m.weight;
  v.reserved = v.padding[0] = v.padding[1] = 0;
  job.voxels[i] = v;
}

}  // namespace ggslam::cuda
