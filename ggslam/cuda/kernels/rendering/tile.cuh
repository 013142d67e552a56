// SPDX-License-Identifier: Apache-2.0
// What compositing and its backward share: a block of threads composites one tile, a thread one pixel; each of the eight
// warps owns 8 x 4 pixels. Splats come to shared memory in batches, with a mask of the warps concerned, and each warp
// goes only through its own.
#pragma once
#include "rendering/workspace.cuh"

namespace ggslam::cuda {

constexpr int kTileThreads = kTileSize * kTileSize;
constexpr int kWarps = kTileThreads / kWarp;
constexpr int kWarpWidth = 8, kWarpHeight = 4;
constexpr int kMaxFeatureGroup = 16;  // feature channels that one launch handles

// Feature channels [first, first + count) of all; count <= the group's size, which is a template argument.
struct FeatureGroup {
  int first, count;
};

struct Pixel {
  int x, y;
  std::int64_t index;
  bool inside;
};

__device__ inline Pixel pixel_of_thread(const Grid& grid, int tile) {
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  const int x = tile % grid.tiles_x * kTileSize + warp % 2 * kWarpWidth + lane % kWarpWidth;
  const int y = tile / grid.tiles_x * kTileSize + warp / 2 * kWarpHeight + lane / kWarpWidth;
  return {x, y, static_cast<std::int64_t>(y) * grid.width + x, x < grid.width && y < grid.height};
}

// The warps of a tile whose pixels a splat reaches, one bit each.
__device__ inline unsigned reached_warps(const Splat& s, const Grid& grid, int tile) {
  const float x0 = static_cast<float>(tile % grid.tiles_x * kTileSize);
  const float y0 = static_cast<float>(tile / grid.tiles_x * kTileSize);
  unsigned result = 0;
#pragma unroll 2  // more at a time would cost the compositing loop its registers
  for (int warp = 0; warp < kWarps; ++warp) {
    const float x = x0 + static_cast<float>(warp % 2 * kWarpWidth), y = y0 + static_cast<float>(warp / 2 * kWarpHeight);
    result |= static_cast<unsigned>(reaches(s, x, y, kWarpWidth - 1, kWarpHeight - 1)) << warp;
  }
  return result;
}

// Splats of a tile in shared memory.
template <int kBatch, int kFeatures>
struct Batch {
  Splat splats[kBatch];
  float4 features[kBatch][kFeatures > 0 ? kFeatures / 4 : 1];
  std::uint32_t rows[kBatch];
  std::uint8_t warps[kBatch];
};

// Copies the features of the batch's n Gaussians, four channels at a time; channels beyond the group's are zero.
template <int kBatch, int kFeatures>
__device__ inline void load_features(Batch<kBatch, kFeatures>& batch, int n, const GaussianArrays& arrays,
                                     const FeatureGroup& group) {
  constexpr int kQuads = kFeatures / 4;
  const bool aligned = arrays.feature_channels % 4 == 0 && reinterpret_cast<std::uintptr_t>(arrays.features) % 16 == 0;
  const bool whole = group.count == kFeatures && aligned;
#pragma unroll 1
  for (int i = threadIdx.x; i < n * kQuads; i += kTileThreads) {
    const int k = i / kQuads, quad = i % kQuads;
    if (batch.warps[k] == 0) continue;
    const float* row = arrays.features + static_cast<std::int64_t>(batch.rows[k]) * arrays.feature_channels +
                       group.first + 4 * quad;
    float4 values;
    if (whole) {
      values = *reinterpret_cast<const float4*>(row);
    } else {
      const int left = group.count - 4 * quad;
      values.x = left > 0 ? row[0] : 0.0f;
      values.y = left > 1 ? row[1] : 0.0f;
      values.z = left > 2 ? row[2] : 0.0f;
      values.w = left > 3 ? row[3] : 0.0f;
    }
    batch.features[k][quad] = values;
  }
}

}  // namespace ggslam::cuda
