// SPDX-License-Identifier: Apache-2.0
// Composites single pixels once more and notes every contribution.
//
// A warp per pixel. A few thousand pixels do not fill a GPU with a thread each, and a thread would wait for memory at
// every splat of a list of hundreds. Here 32 lanes look up kLookahead entries of the tile's list at once, keep those that
// contributed somewhere in the pixel's part of the tile, and evaluate 32 of them side by side. Only the transmittance
// goes through the few that the pixel takes one after another, which leaves it as compositing rounds it.
#pragma once
#include "rendering/pixel_terms.cuh"
#include "rendering/tile.cuh"

namespace ggslam::cuda {

constexpr int kLookahead = 128;

// A pixel on its way through the tile's list; the same in all lanes of its warp.
struct TermWalk {
  float x = 0.0f, y = 0.0f;
  std::uint32_t begin = 0;  // of the tile's list
  int last = -1;            // number in the list of the last contribution, -1: none
  bool closed = false;      // by that contribution, which took all that was left
  int part = 0;             // of the tile that the pixel lies in: bit of `contributed`
  float transmittance = 1.0f;
  int size = 0;             // terms found so far; may be more than there is room for

  // Whether there may be another term: no weight is higher than the transmittance.
  __device__ bool goes_on(int capacity, float min_weight) const {
    return size < capacity && transmittance >= min_weight;
  }
};

__device__ inline TermWalk begin_walk(const Grid& grid, const PixelWorkspace& w, std::int32_t pixel) {
  TermWalk walk;
  if (pixel < 0 || pixel >= grid.width * grid.height) return walk;
  const int x = pixel % grid.width, y = pixel / grid.width;
  walk.x = static_cast<float>(x), walk.y = static_cast<float>(y);
  walk.begin = w.tile_start[y / kTileSize * grid.tiles_x + x / kTileSize];
  walk.last = w.last_entry[pixel];
  walk.closed = w.transmittance[pixel] < 0.0f;
  walk.part = y % kTileSize / kWarpHeight * 2 + x % kTileSize / kWarpWidth;
  return walk;
}

// Lists the Gaussians of entries [first, first + kLookahead) that contributed in the pixel's part of the tile; returns
// how many they are.
__device__ inline int list_contributors(const TermWalk& walk, const PairWorkspace& pairs, int first, int lane,
                                        std::uint32_t* rows) {
  constexpr int kRounds = kLookahead / kWarp;
  bool concerned[kRounds];
#pragma unroll
  for (int i = 0; i < kRounds; ++i) {
    const int k = first + i * kWarp + lane;
    concerned[i] = k <= walk.last && ((pairs.contributed[walk.begin + k] >> walk.part) & 1) != 0;
  }
  // All loads first, then all stores, so that memory is waited for once.
  int places[kRounds], found = 0;
  std::uint32_t loaded[kRounds];
#pragma unroll
  for (int i = 0; i < kRounds; ++i) {
    const unsigned lanes = __ballot_sync(kAllLanes, concerned[i]);
    if (concerned[i]) loaded[i] = pairs.sorted_rows[walk.begin + first + i * kWarp + lane];
    places[i] = found + __popc(lanes & ((1u << lane) - 1));
    found += __popc(lanes);
  }
  __syncwarp();  // the rows listed before have been read
#pragma unroll
  for (int i = 0; i < kRounds; ++i)
    if (concerned[i]) rows[places[i]] = loaded[i];
  __syncwarp();
  return found;
}

// Lets the pixel take up to 32 Gaussians, one per lane, and notes those of weight. closes: the lane's one closed it.
__device__ inline void take_terms(TermWalk& walk, const Splat* splats, bool given, bool closes, std::uint32_t row,
                                  int lane, float min_weight, std::int32_t* gaussians, float* weights, int capacity) {
  float exponent = 2.0f * kLog2MinAlpha;
  if (given) exponent = log2_alpha(splats[row], walk.x - splats[row].mean_x, walk.y - splats[row].mean_y);
  if (closes) exponent = 0.0f;
  const bool taken = exponent >= kLog2MinAlpha;
  const float alpha = taken ? fminf(exp2f(exponent), kMaxAlpha) : 0.0f;
  float weight = 0.0f;
  for (unsigned left = __ballot_sync(kAllLanes, taken); left != 0; left &= left - 1) {
    const int bit = __ffs(static_cast<int>(left)) - 1;
    const float next = __shfl_sync(kAllLanes, alpha, bit) * walk.transmittance;
    walk.transmittance -= next;
    if (lane == bit) weight = next;
  }
  const bool wanted = taken && weight >= min_weight;
  const unsigned lanes = __ballot_sync(kAllLanes, wanted);
  const int place = walk.size + __popc(lanes & ((1u << lane) - 1));
  walk.size += __popc(lanes);
  if (!wanted || place >= capacity) return;
  gaussians[place] = static_cast<std::int32_t>(row);
  weights[place] = weight;
}

// Fills `out` for pixels (row * width + column); one outside the image has no terms.
__global__ void __launch_bounds__(kTermThreads)
collect_terms_kernel(Grid grid, const Splat* splats, PairWorkspace pairs, PixelWorkspace w, const std::int32_t* pixels,
                     float min_weight, PixelTerms out) {
  GGSLAM_SHARED std::uint32_t listed[kTermWarps][kLookahead];
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  const std::int64_t p = static_cast<std::int64_t>(blockIdx.x) * kTermWarps + warp;
  if (p >= out.pixels) return;  // the whole warp
  std::uint32_t* rows = listed[warp];
  std::int32_t* gaussians = out.gaussians + p * out.capacity;
  float* weights = out.weights + p * out.capacity;
  TermWalk walk = begin_walk(grid, w, pixels[p]);
  for (int first = 0; first <= walk.last && walk.goes_on(out.capacity, min_weight); first += kLookahead) {
    const int found = list_contributors(walk, pairs, first, lane, rows);
    for (int k = 0; k < found && walk.goes_on(out.capacity, min_weight); k += kWarp) {
      const bool given = k + lane < found;
      const bool closes = walk.closed && k + lane == found - 1 && first + kLookahead > walk.last;
      take_terms(walk, splats, given, closes, given ? rows[k + lane] : 0, lane, min_weight, gaussians, weights,
                 out.capacity);
    }
  }
  const int size = min(walk.size, out.capacity);
  if (lane == 0) out.counts[p] = size;
#pragma unroll 1
  for (int k = size + lane; k < out.capacity; k += kWarp) gaussians[k] = 0, weights[k] = 0.0f;
}

// Pixels that show one Gaussian each, with weight 1. A thread per place.
__global__ void __launch_bounds__(kTermThreads) single_terms_kernel(const std::int32_t* rows, PixelTerms out) {
  const std::int64_t place = static_cast<std::int64_t>(blockIdx.x) * kTermThreads + threadIdx.x;
  if (place >= out.pixels * out.capacity) return;
  const std::int64_t p = place / out.capacity;
  const bool first = place == p * out.capacity;
  out.gaussians[place] = first ? rows[p] : 0;
  out.weights[place] = first ? 1.0f : 0.0f;
  if (first) out.counts[p] = 1;
}

}  // namespace ggslam::cuda
