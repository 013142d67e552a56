// SPDX-License-Identifier: Apache-2.0
// Device memory that a rendering works in: blocks, laid out here, allocated by the caller.
#pragma once
#include "common/carver.cuh"
#include "rendering/splat.cuh"

namespace ggslam::cuda {

constexpr int kTileSize = 16;  // pixels; a tile is square
constexpr int kBaseGradients = 12;  // log-alpha moments 1, r, dy, r^2, r dy, dy^2; colour; depth; two not in use

// Tiles that a splat's bounding box covers.
struct __align__(8) TileRectangle {
  std::uint16_t x, y, wide, high;
};

// Totals of a rendering, counted by the projection.
struct Totals {
  unsigned long long visible, pairs;
};

struct Grid {
  int width, height, tiles_x, tiles_y;
  float close_below;  // of the view: transmittance below which a pixel is closed
  __host__ __device__ int tiles() const { return tiles_x * tiles_y; }
};

inline Grid make_grid(const CameraView& view) {
  const int tiles_x = (view.width + kTileSize - 1) / kTileSize, tiles_y = (view.height + kTileSize - 1) / kTileSize;
  return {view.width, view.height, tiles_x, tiles_y, view.close_below};
}

// Number of bits that tell apart the numbers from 0 to largest.
inline int bits_of(std::uint32_t largest) {
  int bits = 1;
  while (bits < 32 && (largest >> bits) != 0) ++bits;
  return bits;
}

// Floats from one Gaussian's row of summed image-space gradients to the next: base gradients, then features.
inline int gradient_stride(const GaussianArrays& arrays) {
  const int features = arrays.render_features ? (arrays.feature_channels + 3) / 4 * 4 : 0;
  return (kBaseGradients + features + 15) / 16 * 16;
}

struct GaussianWorkspace {
  Totals* totals;              // at the beginning of the block
  Splat* splats;               // [N]; those of Gaussians that are not visible are undefined
  TileRectangle* rectangles;   // [N], likewise
  std::uint32_t* tile_counts;  // [N], 0: not visible
  std::uint32_t *depth_keys, *sorted_depth_keys;  // [N]
  std::uint32_t *rows, *rows_by_depth;            // [N]
  std::uint32_t *counts_by_depth, *pair_ends;     // [N]; pair_ends: running sum
  void* sorting;               // for sorting and summing N numbers
  std::size_t bytes, sorting_bytes;
};

struct PairWorkspace {
  std::uint32_t *tiles, *sorted_tiles;  // [pairs]
  std::uint32_t *rows, *sorted_rows;    // [pairs]
  std::uint8_t* contributed;            // [pairs]: warps of the tile to which the splat contributed, one bit each
  std::uint32_t capacity;
  void* sorting;
  std::size_t bytes, sorting_bytes;
};

struct PixelWorkspace {
  std::uint32_t* tile_start;  // [tiles + 1]
  float* transmittance;       // [H, W], after the last Gaussian; minus it, where that one has closed the pixel
  std::int32_t* last_entry;   // [H, W], number in the tile's list of the last contribution, -1 for none
  std::size_t bytes;
};

// Whether pairs found no room. Known once the projection is done.
__device__ inline bool out_of_room(const GaussianWorkspace& gaussians, const PairWorkspace& pairs) {
  return gaussians.totals->pairs > pairs.capacity;
}

inline GaussianWorkspace gaussian_workspace(void* block, std::int64_t n, std::size_t sorting_bytes) {
  Carver carver(block);
  GaussianWorkspace w;
  w.totals = carver.take<Totals>(1);
  w.splats = carver.take<Splat>(n);
  w.rectangles = carver.take<TileRectangle>(n);
  w.tile_counts = carver.take<std::uint32_t>(n);
  for (std::uint32_t** part : {&w.depth_keys, &w.sorted_depth_keys, &w.rows, &w.rows_by_depth, &w.counts_by_depth,
                               &w.pair_ends})
    *part = carver.take<std::uint32_t>(n);
  w.sorting = carver.take<char>(static_cast<std::int64_t>(sorting_bytes));
  w.sorting_bytes = sorting_bytes;
  w.bytes = carver.used();
  return w;
}

inline PairWorkspace pair_workspace(void* block, std::int64_t pairs, std::size_t sorting_bytes) {
  Carver carver(block);
  PairWorkspace w;
  for (std::uint32_t** part : {&w.tiles, &w.sorted_tiles, &w.rows, &w.sorted_rows})
    *part = carver.take<std::uint32_t>(pairs);
  w.contributed = carver.take<std::uint8_t>(pairs);
  w.capacity = static_cast<std::uint32_t>(pairs);
  w.sorting = carver.take<char>(static_cast<std::int64_t>(sorting_bytes));
  w.sorting_bytes = sorting_bytes;
  w.bytes = carver.used();
  return w;
}

inline PixelWorkspace pixel_workspace(void* block, const Grid& grid) {
  const std::int64_t pixels = static_cast<std::int64_t>(grid.width) * grid.height;
  Carver carver(block);
  PixelWorkspace w;
  w.tile_start = carver.take<std::uint32_t>(grid.tiles() + 1);
  w.transmittance = carver.take<float>(pixels);
  w.last_entry = carver.take<std::int32_t>(pixels);
  w.bytes = carver.used();
  return w;
}

}  // namespace ggslam::cuda
