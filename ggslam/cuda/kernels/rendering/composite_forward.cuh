// SPDX-License-Identifier: Apache-2.0
// Compositing of a tile, front to back: sum over the depth-sorted splats of weight * (colour, depth, features) with
// weight = alpha * transmittance and transmittance *= 1 - alpha.
#pragma once
#include "rendering/tile.cuh"

namespace ggslam::cuda {

constexpr int kForwardBatch = 256;

// What a pixel gathers.
template <int kFeatures>
struct PixelSums {
  float transmittance, red = 0.0f, green = 0.0f, blue = 0.0f, depth = 0.0f, median_depth = 0.0f;
  float features[kFeatures > 0 ? kFeatures : 1] = {};
  int last = -1;
};

// Lets a pixel take one splat; false if no pixel of the warp takes it. The one that takes the transmittance below
// close_below takes what is left, and leaves minus what kMaxAlpha lets through: the pixel has ended.
template <int kFeatures>
__device__ inline bool take(const Splat& s, const float4* features, float x, float y, int entry,
                            float close_below, PixelSums<kFeatures>& sums) {
  const float exponent = log2_alpha(s, x - s.mean_x, y - s.mean_y);
  const bool taken = exponent >= kLog2MinAlpha && sums.transmittance >= kMinTransmittance;
  if (__ballot_sync(kAllLanes, taken) == 0) return false;
  const float alpha = taken ? fminf(exp2f(exponent), kMaxAlpha) : 0.0f;
  const float before = sums.transmittance;
  float weight = alpha * before;
  sums.transmittance = before - weight;
  if (taken && sums.transmittance < close_below)
    weight = kMaxAlpha * before, sums.transmittance = (kMaxAlpha - 1.0f) * before;
  sums.red += weight * s.red, sums.green += weight * s.green, sums.blue += weight * s.blue;
  sums.depth += weight * s.depth;
  if (before >= 0.5f && sums.transmittance < 0.5f) sums.median_depth = s.depth;
  if (taken) sums.last = entry;
#pragma unroll
  for (int quad = 0; quad < kFeatures / 4; ++quad) {
    const float4 f = features[quad];
    sums.features[4 * quad] += weight * f.x, sums.features[4 * quad + 1] += weight * f.y;
    sums.features[4 * quad + 2] += weight * f.z, sums.features[4 * quad + 3] += weight * f.w;
  }
  return true;
}

template <int kFeatures>
__device__ inline void write_pixel(const RenderTargets& targets, const PixelWorkspace& w, const Grid& grid,
                                   const FeatureGroup& group, const Pixel& pixel, const PixelSums<kFeatures>& sums) {
  if (!pixel.inside) return;
  const std::int64_t plane = static_cast<std::int64_t>(grid.width) * grid.height;
#pragma unroll
  for (int q = 0; q < kFeatures; ++q)
    if (q < group.count) targets.features[(group.first + q) * plane + pixel.index] = sums.features[q];
  if (group.first > 0) return;  // the first group's launch has written the rest
  targets.image[pixel.index] = sums.red;
  targets.image[plane + pixel.index] = sums.green;
  targets.image[2 * plane + pixel.index] = sums.blue;
  targets.depth[pixel.index] = sums.depth;
  targets.alpha[pixel.index] = 1.0f - fabsf(sums.transmittance);
  if (targets.median_depth != nullptr) targets.median_depth[pixel.index] = sums.median_depth;
  w.transmittance[pixel.index] = sums.transmittance;
  w.last_entry[pixel.index] = sums.last;
}

// Brings splats [first, first + n) of the pairs to shared memory.
template <int kFeatures>
__device__ inline void load_batch(Batch<kForwardBatch, kFeatures>& batch, std::uint32_t first, int n, int tile,
                                  const Grid& grid, const GaussianWorkspace& gaussians, const PairWorkspace& pairs) {
  const int k = threadIdx.x;
  if (k >= n) return;
  const std::uint32_t row = pairs.sorted_rows[first + k];
  const Splat s = gaussians.splats[row];
  batch.splats[k] = s;
  batch.rows[k] = row;
  batch.warps[k] = static_cast<std::uint8_t>(reached_warps(s, grid, tile));
}

template <int kFeatures>
__global__ void __launch_bounds__(kTileThreads, 4)
composite_kernel(GaussianArrays arrays, Grid grid, GaussianWorkspace gaussians, PairWorkspace pairs, PixelWorkspace w,
                 RenderTargets targets, FeatureGroup group) {
  static_assert(kForwardBatch == kTileThreads, "one thread brings one splat");
  GGSLAM_SHARED Batch<kForwardBatch, kFeatures> batch;
  GGSLAM_SHARED std::uint32_t contributed[kWarps][kForwardBatch / kWarp];  // one bit per splat
  const int tile = static_cast<int>(blockIdx.x), lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  float x, y;
  PixelSums<kFeatures> sums;
  {
    const Pixel pixel = pixel_of_thread(grid, tile);
    x = static_cast<float>(pixel.x), y = static_cast<float>(pixel.y);
    sums.transmittance = pixel.inside ? 1.0f : 0.0f;  // pixels outside neither take nor keep alive anything
  }
  const std::uint32_t begin = w.tile_start[tile], end = w.tile_start[tile + 1];

  for (std::uint32_t first = begin; first < end; first += kForwardBatch) {
    if (__syncthreads_count(sums.transmittance >= kMinTransmittance) == 0) break;
    const int n = static_cast<int>(min(end - first, static_cast<std::uint32_t>(kForwardBatch)));
    load_batch<kFeatures>(batch, first, n, tile, grid, gaussians, pairs);
    __syncthreads();
    if constexpr (kFeatures > 0) {
      load_features(batch, n, arrays, group);
      __syncthreads();
    }
    bool alive = __ballot_sync(kAllLanes, sums.transmittance >= kMinTransmittance) != 0;
#pragma unroll 1
    for (int chunk = 0; chunk < kForwardBatch / kWarp; ++chunk) {
      const int k0 = chunk * kWarp;
      const bool mine = alive && k0 + lane < n && ((batch.warps[k0 + lane] >> warp) & 1) != 0;
      unsigned taken = 0;
      for (unsigned left = __ballot_sync(kAllLanes, mine); left != 0; left &= left - 1) {
        const int bit = __ffs(static_cast<int>(left)) - 1, k = k0 + bit;
        if (take<kFeatures>(batch.splats[k], batch.features[k], x, y, static_cast<int>(first - begin) + k,
                            grid.close_below, sums))
          taken |= 1u << bit;
      }
      if (lane == 0) contributed[warp][chunk] = taken;
      alive = alive && __ballot_sync(kAllLanes, sums.transmittance >= kMinTransmittance) != 0;
    }
    __syncthreads();
    if (static_cast<int>(threadIdx.x) < n && group.first == 0) {
      unsigned warps = 0;
      for (int i = 0; i < kWarps; ++i) warps |= ((contributed[i][threadIdx.x / kWarp] >> lane) & 1u) << i;
      pairs.contributed[first + threadIdx.x] = static_cast<std::uint8_t>(warps);
    }
  }
  // The pixel is worked out anew rather than kept in registers all along.
  write_pixel<kFeatures>(targets, w, grid, group, pixel_of_thread(grid, tile), sums);
}

}  // namespace ggslam::cuda
