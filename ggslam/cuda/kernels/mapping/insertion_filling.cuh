// SPDX-License-Identifier: Apache-2.0
// Where pixels without depth become Gaussians, and at what depth: that of the nearest pixel that has one.
//
// The nearest pixel is found exactly, in two passes as distance transforms are (Felzenszwalb and Huttenlocher 2012):
// within each column for all pixels, then across the columns, only for those that are filled, out to both sides until
// nothing nearer can come.
#pragma once
#include "mapping/insertion.cuh"

namespace ggslam::cuda::insertion {

constexpr int kColumns = 32, kPieces = 16;  // columns of a block, and pieces that each column is cut into
constexpr int kColumnThreads = kColumns * kPieces;
constexpr int kFillThreads = 128;

// Row of the nearest pixel with depth in each pixel's column; of two equally near ones the upper.
__global__ void __launch_bounds__(kColumnThreads) known_row_kernel(InsertionJob job, Workspace w) {
  GGSLAM_SHARED int highest[kPieces][kColumns], lowest[kPieces][kColumns];  // known rows of each piece, -1 = none
  const int lane = threadIdx.x % kColumns, piece = threadIdx.x / kColumns;
  const int x = static_cast<int>(blockIdx.x) * kColumns + lane, length = (job.height + kPieces - 1) / kPieces;
  const int begin = piece * length, end = x < job.width ? min(begin + length, job.height) : 0;
  int first = -1, last = -1;
  for (int y = begin; y < end; ++y) {
    if (job.depth[static_cast<std::int64_t>(y) * job.width + x] == 0) continue;
    if (first < 0) first = y;
    last = y;
  }
  highest[piece][lane] = first;
  lowest[piece][lane] = last;
  __syncthreads();
  int above = -1, below = -1;
  for (int p = 0; p < piece; ++p) above = max(above, lowest[p][lane]);
  for (int p = kPieces - 1; p > piece; --p) below = highest[p][lane] >= 0 ? highest[p][lane] : below;
  for (int y = begin; y < end; ++y) {
    const std::int64_t pixel = static_cast<std::int64_t>(y) * job.width + x;
    if (job.depth[pixel] != 0) above = y;
    w.known_row[pixel] = above;
  }
  for (int y = end - 1; y >= begin; --y) {
    const std::int64_t pixel = static_cast<std::int64_t>(y) * job.width + x;
    if (job.depth[pixel] != 0) below = y;
    const int up = w.known_row[pixel];  // this thread's own, of the loop before
    if (up < 0 || (below >= 0 && below - y < y - up)) w.known_row[pixel] = below;
  }
}

// Depth in metres of the pixel with depth that is nearest to (x, y), 0 if no pixel has any.
__device__ inline float nearest_depth(const InsertionJob& job, const Workspace& w, int x, int y) {
  const std::int32_t* rows = w.known_row + static_cast<std::int64_t>(y) * job.width;
  std::int64_t nearest = INT64_MAX;  // squared distance
  int column = -1;
  for (std::int64_t d = 0; d < job.width && d * d < nearest; ++d) {
    for (int side = -1; side <= 1; side += 2) {
      const int other = x + side * static_cast<int>(d);
      if (other < 0 || other >= job.width || rows[other] < 0) continue;
      const std::int64_t height = rows[other] - y, squared = d * d + height * height;
      if (squared < nearest) nearest = squared, column = other;
    }
  }
  return column < 0 ? 0.0f : depth_at(job, column, rows[column]);
}

// Chooses among the points of the grid for filling, a thread for each.
__global__ void __launch_bounds__(kFillThreads)
choose_filling_kernel(InsertionJob job, Candidates candidates, Workspace w) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kFillThreads + threadIdx.x;
  if (i >= candidates.count - candidates.pixels) return;
  const int x = static_cast<int>(i % candidates.fill_wide) * job.fill_stride + job.fill_stride / 2;
  const int y = static_cast<int>(i / candidates.fill_wide) * job.fill_stride + job.fill_stride / 2;
  const std::int64_t pixel = static_cast<std::int64_t>(y) * job.width + x;
  const bool unknown = job.depth[pixel] == 0 && (job.alpha == nullptr || job.alpha[pixel] < 0.5f);
  const float z = unknown ? nearest_depth(job, w, x, y) : 0.0f;
  w.chosen[candidates.pixels + i] = z > 0.0f ? 1u : 0u;
  w.fill_depth[i] = z;
}

}  // namespace ggslam::cuda::insertion
