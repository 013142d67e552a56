// SPDX-License-Identifier: Apache-2.0
// The arguments of inserting Gaussians from a keyframe, and the memory that it works in. What is inserted where is
// stated in ggslam/mapping/cpu/insertion.py.
#pragma once
#include "common/carver.cuh"
#include "common/sorting.cuh"
#include "abi/cuda/mapping.hpp"

namespace ggslam::cuda {

namespace insertion {

// Number of grid lines of a stride, the first at stride / 2.
__host__ __device__ inline int grid_lines(int size, int stride) {
  return stride > 0 && size > stride / 2 ? (size - stride / 2 - 1) / stride + 1 : 0;
}

// The candidates are all pixels, row by row, and after them the points of the grid for filling, row by row.
struct Candidates {
  std::int64_t pixels;
  int fill_wide;
  std::int64_t count;
};

inline Candidates candidates_of(const InsertionJob& job) {
  const std::int64_t pixels = static_cast<std::int64_t>(job.height) * job.width;
  const int wide = grid_lines(job.width, job.fill_stride), high = grid_lines(job.height, job.fill_stride);
  return {pixels, wide, pixels + static_cast<std::int64_t>(wide) * high};
}

constexpr std::uint32_t kCoarse = 0x80000000u;  // in a chosen candidate's number: it has stride 2

struct Workspace {
  std::uint32_t* chosen;    // [candidates], 1 where a Gaussian is to be
  std::uint32_t* sums;      // [candidates], running sum of `chosen`
  std::uint32_t* order;     // [candidates]: the chosen ones' numbers, one after the other, with kCoarse
  std::uint8_t* coarse;     // [pixels]
  std::int32_t* known_row;  // [H, W]: row of the nearest pixel with depth in the same column, -1 = none
  float* fill_depth;        // [candidates - pixels], metres
  void* scratch;
  std::size_t scratch_bytes, bytes;
};

inline Workspace workspace_of(void* block, const InsertionJob& job) {
  const Candidates c = candidates_of(job);
  Carver carver(block);
  Workspace w;
  w.chosen = carver.take<std::uint32_t>(c.count);
  w.sums = carver.take<std::uint32_t>(c.count);
  w.order = carver.take<std::uint32_t>(c.count);
  w.coarse = carver.take<std::uint8_t>(c.pixels);
  w.known_row = carver.take<std::int32_t>(c.count > c.pixels ? c.pixels : 0);
  w.fill_depth = carver.take<float>(c.count - c.pixels);
  w.scratch_bytes = sorting_bytes(c.count);
  w.scratch = carver.take<char>(static_cast<std::int64_t>(w.scratch_bytes));
  w.bytes = carver.used();
  return w;
}

__device__ inline float depth_at(const InsertionJob& job, int x, int y) {
  return static_cast<float>(job.depth[static_cast<std::int64_t>(y) * job.width + x]) / job.units_per_metre;
}

// The index in [0, size) that OpenCV's border "reflect 101" (dcb|abcd|cba) takes for i.
__device__ inline int reflected(int i, int size) {
  if (size == 1) return 0;
  while (i < 0 || i >= size) i = i < 0 ? -i : 2 * size - 2 - i;
  return i;
}

}  // namespace insertion
}  // namespace ggslam::cuda
