// SPDX-License-Identifier: Apache-2.0
// The k nearest other points of some of many points, by comparing with all of them.
//
// A warp serves one row: its lanes measure 32 points at a time and keep the nearest found so far as a sorted list with
// one entry in each lane, so that a point that belongs in it is inserted by the whole warp at once. Points pass through
// shared memory, where a block's warps all use them. So that a few hundred rows keep a whole GPU busy, the points are
// cut into parts, each of which yields a list for each row; a second kernel merges the lists. Of equally near points
// those of the lowest numbers are taken, whatever the parts.
#pragma once
#include "common/carver.cuh"
#include "abi/cuda/mapping.hpp"

namespace ggslam::cuda {

namespace neighbours {

static_assert(kMostNeighbours == kWarp, "a list has one entry in each lane");
constexpr int kRowsPerBlock = 16, kThreads = kRowsPerBlock * kWarp;
constexpr int kTile = 1024;    // points in shared memory
constexpr int kPerLane = 4;    // points that a lane measures before the list is looked at
constexpr int kBlocks = 396;   // enough to fill a large GPU: 132 multiprocessors with 3 blocks each
static_assert(kTile % (kPerLane * kWarp) == 0, "a tile is measured in whole steps");

// How the work is cut: `tiles` of points make a part.
struct Parts {
  int count, tiles;
};

inline Parts parts_of(const NeighbourJob& job) {
  const int row_blocks = (job.row_count + kRowsPerBlock - 1) / kRowsPerBlock;
  const int all = (job.point_count - 1) / kTile + 1, wanted = kBlocks / row_blocks;  // so that they run all at once
  const int tiles = wanted > 0 ? (all - 1) / wanted + 1 : all;
  return {(all - 1) / tiles + 1, tiles};
}

struct Workspace {
  float* distances;       // [M, parts, k], squared; infinite where there is no point
  std::int32_t* indices;  // [M, parts, k]
  std::size_t bytes;
};

inline Workspace workspace_of(void* block, const NeighbourJob& job) {
  const std::int64_t entries = static_cast<std::int64_t>(job.row_count) * parts_of(job).count * job.k;
  Carver carver(block);
  Workspace w;
  w.distances = carver.take<float>(entries);
  w.indices = carver.take<std::int32_t>(entries);
  w.bytes = carver.used();
  return w;
}

// The nearest so far in ascending order, an entry in each lane; the first k count.
struct NearestList {
  float distance = INFINITY;  // squared
  std::int32_t index = -1;
  float farthest = INFINITY;  // of the first k, the same in all lanes
};

// Takes the lanes' points into the list where they are nearer than what is there. Whole warps call it.
__device__ inline void take_nearer(NearestList& list, int k, int lane, float distance, std::int32_t index) {
  unsigned nearer = __ballot_sync(kAllLanes, distance < list.farthest);  // false for NaN
  for (; nearer != 0; nearer &= nearer - 1) {
    const int from = __ffs(static_cast<int>(nearer)) - 1;
    const float d = __shfl_sync(kAllLanes, distance, from);
    const std::int32_t i = __shfl_sync(kAllLanes, index, from);
    if (!(d < list.farthest)) continue;  // the list got nearer meanwhile; d and the list are the same in all lanes
    const int place = __popc(__ballot_sync(kAllLanes, list.distance <= d));
    const int before = lane > 0 ? lane - 1 : 0;
    const float shifted_distance = __shfl_sync(kAllLanes, list.distance, before);
    const std::int32_t shifted_index = __shfl_sync(kAllLanes, list.index, before);
    if (lane >= place) {
      list.distance = lane == place ? d : shifted_distance;
      list.index = lane == place ? i : shifted_index;
    }
    list.farthest = __shfl_sync(kAllLanes, list.distance, k - 1);
  }
}

// Squared distance of a point in shared memory.
__device__ inline float squared_distance(const float* point, const float (&query)[3]) {
  const float x = point[0] - query[0], y = point[1] - query[1], z = point[2] - query[2];
  return x * x + y * y + z * z;
}

// Compares a tile's points, numbered from `first`, with one row's.
__device__ inline void search_tile(const float* tile, int first, int count, std::int32_t row, const float (&query)[3],
                                   int k, int lane, NearestList& list) {
  for (int begin = 0; begin < count; begin += kPerLane * kWarp) {
    float distances[kPerLane], least = INFINITY;
#pragma unroll
    for (int i = 0; i < kPerLane; ++i) {
      const int j = begin + i * kWarp + lane;
      const bool other = j < count && first + j != row;
      distances[i] = other ? squared_distance(tile + 3 * j, query) : INFINITY;
      least = fminf(least, distances[i]);  // of a number and NaN it is the number
    }
    if (__ballot_sync(kAllLanes, least < list.farthest) == 0) continue;
#pragma unroll
    for (int i = 0; i < kPerLane; ++i)
      take_nearer(list, k, lane, distances[i], first + begin + i * kWarp + lane);
  }
}

// Nearest points of 16 rows among those of one part. Blocks: [row blocks][parts].
__global__ void __launch_bounds__(kThreads, 3) search_kernel(NeighbourJob job, Parts parts, Workspace w) {
  GGSLAM_SHARED float tile[3 * kTile];
  const int lane = threadIdx.x % kWarp, part = static_cast<int>(blockIdx.x) % parts.count;
  const int entry = static_cast<int>(blockIdx.x) / parts.count * kRowsPerBlock + static_cast<int>(threadIdx.x) / kWarp;
  // Warps of the last block that have no row repeat the last one.
  const std::int32_t row = static_cast<std::int32_t>(job.rows[min(entry, job.row_count - 1)]);
  const float* point = job.points + 3 * static_cast<std::int64_t>(row);
  const float query[3] = {point[0], point[1], point[2]};
  NearestList list;
  const int last_tile = (job.point_count - 1) / kTile;
  for (int t = part * parts.tiles; t < (part + 1) * parts.tiles && t <= last_tile; ++t) {
    const int first = t * kTile, count = min(kTile, job.point_count - first);
    const float* points = job.points + 3 * static_cast<std::int64_t>(first);
    __syncthreads();  // the tile before is not needed any more
    for (int i = threadIdx.x; i < 3 * count; i += kThreads) tile[i] = points[i];
    __syncthreads();
    search_tile(tile, first, count, row, query, job.k, lane, list);
  }
  if (entry >= job.row_count || lane >= job.k) return;
  const std::int64_t out = (static_cast<std::int64_t>(entry) * parts.count + part) * job.k + lane;
  w.distances[out] = list.distance;
  w.indices[out] = list.index;
}

// Merges the parts' lists, a warp for each row. Where there are fewer points than k, the row itself fills up.
__global__ void __launch_bounds__(kThreads) merge_kernel(NeighbourJob job, Parts parts, Workspace w) {
  const int lane = threadIdx.x % kWarp;
  const int entry = static_cast<int>(blockIdx.x) * kRowsPerBlock + static_cast<int>(threadIdx.x) / kWarp;
  if (entry >= job.row_count) return;
  const int count = parts.count * job.k;
  const std::int64_t first = static_cast<std::int64_t>(entry) * count;
  NearestList list;
  for (int begin = 0; begin < count; begin += kWarp) {
    const bool inside = begin + lane < count;
    const float distance = inside ? w.distances[first + begin + lane] : INFINITY;
    take_nearer(list, job.k, lane, distance, inside ? w.indices[first + begin + lane] : -1);
  }
  if (lane < job.k)
    job.neighbours[static_cast<std::int64_t>(entry) * job.k + lane] = list.index < 0 ? job.rows[entry] : list.index;
}

}  // namespace neighbours
}  // namespace ggslam::cuda
