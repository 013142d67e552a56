// SPDX-License-Identifier: Apache-2.0
// What single pixels tell the voxels that they, or their rays, fall into: the octants that have measured points, and, for
// the integrators `rays` and `hybrid`, the distances to the depth of rays (native/src/volumes/tsdf_rays.cpp).
#pragma once
#include "volumes/block_updates.cuh"

namespace ggslam::cuda {

// Octants of voxels from a corner of blocks: at depth z of a column u they are floor(origin + z (first + u step)) along the
// map's axes.
struct OctantView {
  double axes[9];     // of the camera in the map
  double octant;      // edge, metres
  double across, down, cx, cy;  // 1 / focal length, middle
  float origin[3];
  std::int32_t corner[3];  // block
};

// A voxel's row in its block.
__device__ inline int row_of(std::int32_t x, std::int32_t y, std::int32_t z) {
  return (x & 7) + kSide * (y & 7) + kSide * kSide * (z & 7);
}

// A thread for each pixel.
__global__ void __launch_bounds__(kPixelThreads) mark_points_kernel(FuseJob job, OctantView view) {
  const std::int64_t pixel = static_cast<std::int64_t>(blockIdx.x) * kPixelThreads + threadIdx.x;
  if (pixel >= static_cast<std::int64_t>(job.height) * job.width || is_stopped(job.map)) return;
  const float z = job.prepared[pixel];
  if (!(z > 0) || z > job.settings.max_depth) return;
  const float u = static_cast<float>(pixel % job.width);
  const double y = (static_cast<double>(pixel / job.width) - view.cy) * view.down;
  std::int32_t o[3];
  for (int a = 0; a < 3; ++a) {
    const double* axes = view.axes + 3 * a;
    const float first = static_cast<float>((axes[0] * (-view.cx * view.across) + axes[1] * y + axes[2]) / view.octant);
    const float step = static_cast<float>(axes[0] * view.across / view.octant);
    o[a] = __float2int_rd(view.origin[a] + z * (first + u * step));
  }
  const std::int32_t n =
      update_of(job, view.corner[0] + (o[0] >> 4), view.corner[1] + (o[1] >> 4), view.corner[2] + (o[2] >> 4));
  if (n < 0) return;
  const int voxel = row_of(o[0] >> 1, o[1] >> 1, o[2] >> 1);
  const int bit = (o[0] & 1) + 2 * (o[1] & 1) + 4 * (o[2] & 1) + 8 * (voxel & 3);
  std::uint32_t* const word = job.octants + static_cast<std::int64_t>(n) * (kVoxels / 4) + voxel / 4;
  if ((*word >> bit & 1) == 0) atomicOr(word, std::uint32_t{1} << bit);
}

// Lengths in voxels from the first voxel of the corner's block.
struct RayView {
  double axes[9], position[3];
  double depth_offset;            // depth of a place: its scalar product with the third axis, plus this
  double truncation, radius;
  double across, down, cx, cy, voxel;
  std::int32_t corner[3];
};

// Adds what a ray measures to a voxel, if it passes it near enough.
__device__ inline void tell_voxel(const FuseJob& job, const RayView& view, const double (&way)[3], double depth,
                                  const std::int32_t (&at)[3]) {
  const std::int32_t n =
      update_of(job, view.corner[0] + (at[0] >> 3), view.corner[1] + (at[1] >> 3), view.corner[2] + (at[2] >> 3));
  if (n < 0) return;
  double z = view.depth_offset, square = 0;
  for (int a = 0; a < 3; ++a) z += view.axes[3 * a + 2] * (at[a] + 0.5);
  const double distance = depth - z;
  if (fabs(distance) > view.truncation) return;
  for (int a = 0; a < 3; ++a) {
    const double offset = view.position[a] + z * way[a] - (at[a] + 0.5);
    square += offset * offset;
  }
  if (square > view.radius * view.radius) return;
  FusedRays& sum = job.rays[static_cast<std::int64_t>(n) * kVoxels + row_of(at[0], at[1], at[2])];
  const double unit = volumes::kRayUnits / view.truncation;
  atomicAdd(&sum.distance, static_cast<std::int32_t>(floor(fabs(unit * distance) + 0.5)) * (distance < 0 ? -1 : 1));
  atomicAdd(&sum.count, 1);
}

// Casts the ray of each pixel through the voxels within the truncation of its depth, a thread for each (J. Amanatides and
// A. Woo, "A fast voxel traversal algorithm for ray tracing", 1987).
__global__ void __launch_bounds__(kPixelThreads) cast_rays_kernel(FuseJob job, RayView view) {
  const std::int64_t pixel = static_cast<std::int64_t>(blockIdx.x) * kPixelThreads + threadIdx.x;
  if (pixel >= static_cast<std::int64_t>(job.height) * job.width || is_stopped(job.map)) return;
  const float measured = job.prepared[pixel];
  if (!(measured > 0) || measured > job.settings.max_depth) return;
  const double ray[3] = {(static_cast<double>(pixel % job.width) - view.cx) * view.across,
                         (static_cast<double>(pixel / job.width) - view.cy) * view.down, 1.0};
  const double depth = static_cast<double>(measured) / view.voxel;
  const double from = fmax(0.0, depth - view.truncation), to = depth + view.truncation;
  double way[3], next[3], step[3];
  std::int32_t at[3], sign[3];
  for (int a = 0; a < 3; ++a) {
    way[a] = view.axes[3 * a] * ray[0] + view.axes[3 * a + 1] * ray[1] + view.axes[3 * a + 2] * ray[2];
    const double start = view.position[a] + from * way[a];
    at[a] = static_cast<std::int32_t>(floor(start));
    sign[a] = way[a] > 0 ? 1 : -1;
    const bool level = fabs(way[a]) < 1e-12;
    next[a] = level ? 1e300 : from + (at[a] + (way[a] > 0 ? 1.0 : 0.0) - start) / way[a];
    step[a] = level ? 0.0 : fabs(1.0 / way[a]);
  }
  for (;;) {
    tell_voxel(job, view, way, depth, at);
    const int a = next[0] < next[1] ? (next[0] < next[2] ? 0 : 2) : (next[1] < next[2] ? 1 : 2);
    if (next[a] > to) return;
#pragma unroll
    for (int b = 0; b < 3; ++b)
      if (b == a) at[b] += sign[b], next[b] += step[b];
  }
}

}  // namespace ggslam::cuda
