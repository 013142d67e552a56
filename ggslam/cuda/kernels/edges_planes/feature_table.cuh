// SPDX-License-Identifier: Apache-2.0
// The voxels of the local map and how they are found: the rules of FeatureMap in ggslam/tracking/edges_planes/voxels.py,
// where they are explained.
#pragma once
#include "abi/cuda/tracked_features.hpp"
#include "common/host.cuh"
#include "tracking/rigid_motion.cuh"

namespace ggslam::cuda {

constexpr std::int64_t kVoxelOffset = 1 << 19;  // makes coordinates of voxels positive
constexpr std::int64_t kEdgeBit = std::int64_t{1} << 60;
constexpr std::int64_t kCoordinateMask = (1 << 20) - 1;

// A point at a pose, each sum rounded in the order of a product of matrices.
__device__ inline void place_point(const FloatPose& pose, const float* q, float (&p)[3]) {
#pragma unroll
  for (int a = 0; a < 3; ++a) {
    const float* r = pose.rotation + 3 * a;
    p[a] = __fadd_rn(__fmaf_rn(r[2], q[2], __fmaf_rn(r[1], q[1], __fmul_rn(r[0], q[0]))), pose.translation[a]);
  }
}

// A whole number as float; what is none, or too large, becomes the least.
__device__ inline std::int64_t whole_number(float x) {
  return fabsf(x) < 9.0e18f ? static_cast<std::int64_t>(x) : static_cast<std::int64_t>(std::uint64_t{1} << 63);
}

// Key of the voxel that holds a point moved by `shift` voxels down.
__device__ inline std::int64_t voxel_key(const FeatureTable& table, const float (&p)[3], bool edge, float shift) {
  const float scale = edge ? table.edges_per_metre : table.planes_per_metre;
  std::uint64_t key = edge ? static_cast<std::uint64_t>(kEdgeBit) : 0;
#pragma unroll
  for (int a = 0; a < 3; ++a) {
    const float cell = floorf(__fadd_rn(__fmul_rn(p[a], scale), static_cast<float>(kVoxelOffset) - shift));
    key += static_cast<std::uint64_t>(whole_number(cell)) << (40 - 20 * a);
  }
  return static_cast<std::int64_t>(key);
}

// Fibonacci hashing.
__device__ inline std::int64_t slot_of(const FeatureTable& table, std::int64_t key) {
  const std::uint64_t product = static_cast<std::uint64_t>(key) * 0x9E3779B97F4A7C15ull;
  return static_cast<std::int64_t>((product >> table.shift) & static_cast<std::uint64_t>(table.slots - 1));
}

// Slot of the voxel with the nearest mean among the eight about a point, or -1. A plane's normal must agree; zero agrees
// with all.
__device__ inline std::int32_t find_surface(const FeatureTable& table, const float (&p)[3], const float (&normal)[3],
                                            bool edge) {
  const std::int64_t low = voxel_key(table, p, edge, 0.5f);
  const float reach = table.match_voxels / (edge ? table.edges_per_metre : table.planes_per_metre);
  const bool has_normal = normal[0] != 0 || normal[1] != 0 || normal[2] != 0;
  float nearest = __uint_as_float(0x7f800000u);  // infinity
  std::int32_t best = -1;
#pragma unroll
  for (int corner = 0; corner < 8; ++corner) {
    const std::uint64_t x = static_cast<std::uint64_t>(corner >> 2), y = static_cast<std::uint64_t>(corner >> 1 & 1);
    const std::uint64_t step = (x << 40) + (y << 20) + static_cast<std::uint64_t>(corner & 1);
    const std::int64_t key = static_cast<std::int64_t>(static_cast<std::uint64_t>(low) + step);
    const std::int64_t slot = slot_of(table, key);
    if (table.keys[slot] != key) continue;
    const float* surface = table.surfaces + 8 * slot;
    if (!(surface[6] > 0)) continue;
    const float dot = surface[3] * normal[0] + surface[4] * normal[1] + surface[5] * normal[2];
    if (has_normal && !(dot >= table.min_normal_dot)) continue;
    const float dx = surface[0] - p[0], dy = surface[1] - p[1], dz = surface[2] - p[2];
    const float squared = dx * dx + dy * dy + dz * dz;
    if (squared < nearest) nearest = squared, best = static_cast<std::int32_t>(slot);
  }
  return nearest < reach * reach ? best : -1;
}

}  // namespace ggslam::cuda
