// SPDX-License-Identifier: Apache-2.0
// Rays walk from block to block, and in blocks with surface from cell to cell: native/src/volumes/kernels/raycast.cpp.
#pragma once
#include "volumes/ray_cells.cuh"
#include "volumes/surface_cells.cuh"

namespace ggslam::cuda {

constexpr int kRayTile = 16, kRayThreads = kRayTile * kRayTile;  // pixels of a block of threads

struct RayHit {
  std::int32_t row;  // -1: none
  int cell[3];
  float depth;
};

// The block and voxel of a cell's corner.
__device__ inline void corner_of(const CastJob& job, std::int32_t row, const int (&cell)[3], int corner,
                                 std::int32_t& found, int& voxel) {
  const int x = cell[0] + (corner & 1), y = cell[1] + (corner >> 1 & 1), z = cell[2] + (corner >> 2);
  voxel = (x & 7) + kSide * (y & 7) + kSide * kSide * (z & 7);
  const std::int32_t* at = job.map.blocks[row].at;
  found = ((x | y | z) & kSide) == 0 ? row : find_block(job.map, at[0] + (x >> 3), at[1] + (y >> 3), at[2] + (z >> 3));
}

__device__ inline CellField field_of_cell(const CastJob& job, std::int32_t row, const int (&cell)[3]) {
  CellField field;
  for (int c = 0; c < 8; ++c) {
    std::int32_t found;
    int voxel;
    corner_of(job, row, cell, c, found, voxel);
    field.value[c] = static_cast<float>(known_value(job.map, found, voxel, 0));
  }
  for (int a = 0; a < 3; ++a) field.origin[a] = static_cast<float>(kSide * job.map.blocks[row].at[a] + cell[a]);
  return field;
}

// From cell to cell of a block; true where the ray meets the surface from its free side.
__device__ inline bool walk_cells(const CastJob& job, const Ray& ray, std::int32_t row, float depth, RayKnowledge& knows,
                                  RayHit& hit) {
  const std::int32_t* at = job.map.blocks[row].at;
  const int low[3] = {kSide * at[0], kSide * at[1], kSide * at[2]};
  float here[3];
  int start[3];
  place_on(ray, depth, here);
  for (int a = 0; a < 3; ++a) start[a] = min(max(static_cast<int>(floorf(here[a])), low[a]), low[a] + kSide - 1);
  RaySteps steps = steps_from(ray, start, 1);
  for (;;) {
    const int cell[3] = {steps.x - low[0], steps.y - low[1], steps.z - low[2]};
    if (static_cast<unsigned>(cell[0] | cell[1] | cell[2]) >= kSide) return false;
    const float leaves = advance_ray(steps);
    const std::uint64_t word = job.cells[8 * static_cast<std::int64_t>(row) + cell[2]];
    if ((word >> (cell[0] + 8 * cell[1]) & 1) == 0) {
      knows.known = false;
    } else if (meets_surface(field_of_cell(job, row, cell), ray, depth, leaves, knows, hit.depth)) {
      hit.row = row;
      for (int a = 0; a < 3; ++a) hit.cell[a] = cell[a];
      return true;
    }
    depth = leaves;
  }
}

__device__ inline RayHit walk_blocks(const CastJob& job, const Ray& ray) {
  RayHit hit{-1, {0, 0, 0}, 0};
  RayKnowledge knows{false, 0};
  float here[3];
  int start[3];
  place_on(ray, job.nearest, here);
  for (int a = 0; a < 3; ++a) start[a] = static_cast<int>(floorf(here[a])) & ~(kSide - 1);
  RaySteps steps = steps_from(ray, start, kSide);
  for (float depth = job.nearest; depth < job.farthest; depth = advance_ray(steps)) {
    const std::int32_t row = find_block(job.map, steps.x >> 3, steps.y >> 3, steps.z >> 3);
    if (row < 0 || (job.kinds[row] & kHasCells) == 0)
      knows.known = false;
    else if (walk_cells(job, ray, row, depth, knows, hit))
      break;
  }
  return hit;
}

// Mean colour of the voxels around a hit, and the label of the nearest that has one.
__device__ inline void paint_pixel(const CastJob& job, const RayHit& hit, const float (&share)[3], std::int64_t pixel) {
  float color[3] = {0, 0, 0}, colored = 0, nearest = -1;
  std::uint16_t label = 0;
  for (int c = 0; c < 8; ++c) {
    std::int32_t row;
    int voxel;
    corner_of(job, hit.row, hit.cell, c, row, voxel);
    if (row < 0 || job.map.blocks[row].slot < 0) continue;
    const FusedVoxels& v = job.map.voxels[job.map.blocks[row].slot];
    const int red = v.red[voxel], green = v.green[voxel], blue = v.blue[voxel];
    const float w = (c & 1 ? share[0] : 1 - share[0]) * (c & 2 ? share[1] : 1 - share[1]) *
                    (c & 4 ? share[2] : 1 - share[2]);
    if (v.label[voxel] != 0 && w > nearest) nearest = w, label = v.label[voxel];
    color[0] += w * red, color[1] += w * green, color[2] += w * blue;
    colored += (red | green | blue) != 0 ? w : 0.0f;  // black: has none
  }
  const float lift = colored > 0 ? 1 / colored : 0;
  for (int a = 0; a < 3; ++a) job.colors[3 * pixel + a] = static_cast<std::uint8_t>(color[a] * lift + 0.5f);
  job.labels[pixel] = label;
}

__device__ inline void describe_hit(const CastJob& job, const Ray& ray, const RayHit& hit, std::int64_t pixel) {
  const CellField field = field_of_cell(job, hit.row, hit.cell);
  float share[3], gradient[3];
  inside_cell(field, ray, hit.depth, share);
  cell_gradient(field, share, gradient);
  const float scale = 1 / sqrtf(gradient[0] * gradient[0] + gradient[1] * gradient[1] + gradient[2] * gradient[2]);
  for (int a = 0; a < 3; ++a) {
    float normal = 0;
    for (int b = 0; b < 3; ++b) normal += job.rotation[3 * b + a] * gradient[b] * scale;
    job.normals[3 * pixel + a] = normal;
  }
  paint_pixel(job, hit, share, pixel);
  job.depth[pixel] = hit.depth;
}

// A thread for each pixel, a block of threads for 16 x 16 of them.
__global__ void __launch_bounds__(kRayThreads, 1) cast_kernel(CastJob job, int tiles_wide) {
  if (is_stopped(job.map)) return;
  const int x = static_cast<int>(blockIdx.x) % tiles_wide * kRayTile + static_cast<int>(threadIdx.x) % kRayTile;
  const int y = static_cast<int>(blockIdx.x) / tiles_wide * kRayTile + static_cast<int>(threadIdx.x) / kRayTile;
  if (x >= job.width || y >= job.height) return;
  const std::int64_t pixel = static_cast<std::int64_t>(y) * job.width + x;
  const Ray ray = ray_through(job, x, y, job.map.voxel);
  const RayHit hit = walk_blocks(job, ray);
  if (hit.row >= 0 && hit.depth >= job.nearest && hit.depth <= job.farthest) {
    describe_hit(job, ray, hit, pixel);
    return;
  }
  job.depth[pixel] = 0;
  for (int a = 0; a < 3; ++a) job.normals[3 * pixel + a] = 0, job.colors[3 * pixel + a] = 0;
  job.labels[pixel] = 0;
}

}  // namespace ggslam::cuda
