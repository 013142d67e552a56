// SPDX-License-Identifier: Apache-2.0
// What compositing and its backward share: a tile's pixels, the exponent of a splat, masks of sub-blocks.
#pragma once
#include "rendering/kernels/tile_layout.hpp"

namespace ggslam::GGSLAM_ISA {

struct Tile {
  int x0, y0;                    // its first pixel
  std::uint32_t begin, end;      // its entries
  Float x[kSubBlocks], y[kSubBlocks];  // pixel centres
};

static inline int sub_block_x(const Tile& tile, int s) { return tile.x0 + s % kSubColumns * kSubWidth; }
static inline int sub_block_y(const Tile& tile, int s) { return tile.y0 + s / kSubColumns * kSubHeight; }

static inline Tile make_tile(const Rasterizer& r, int index) {
  Tile tile;
  tile.x0 = index % r.tiles_x * kTileWidth;
  tile.y0 = index / r.tiles_x * kTileHeight;
  tile.begin = r.tile_start[index];
  tile.end = r.tile_start[index + 1];
  Float column, row;
  for (int lane = 0; lane < kLanes; ++lane) {
    column[lane] = static_cast<float>(lane & 3);
    row[lane] = static_cast<float>(lane >> 2);
  }
  for (int s = 0; s < kSubBlocks; ++s) {
    tile.x[s] = column + static_cast<float>(sub_block_x(tile, s));
    tile.y[s] = row + static_cast<float>(sub_block_y(tile, s));
  }
  return tile;
}

constexpr std::int32_t kNever = 0x7fffffff;  // number of no splat

// How far a pixel at (dx, dy) from the mean is from the place of highest alpha in its row.
static inline Float shear(const Splat& g, Float dx, Float dy) { return dx - g.slope_x * dy; }

// log2 of alpha before the limit kMaxAlpha; r: see `shear`.
static inline Float log2_alpha(const Splat& g, Float r, Float dy) {
  return g.conic_r * r * r + (g.conic_y * dy * dy + g.log2_opacity);
}

// Writes a sub-block to an image plane [H, W]; pixels outside the image are dropped.
static inline void store_sub_block(float* plane, const CameraView& view, int x0, int y0, Float values) {
  alignas(64) float pixels[kLanes];
  store(pixels, values);
  const bool whole = x0 + kSubWidth <= view.width && y0 + kSubHeight <= view.height;
  for (int row = 0; row < kSubHeight && (whole || y0 + row < view.height); ++row) {
    float* out = plane + static_cast<std::size_t>(y0 + row) * view.width + x0;
    if (whole) {
      __builtin_memcpy(out, pixels + 4 * row, 4 * sizeof(float));
    } else {
      for (int i = 0; i < kSubWidth && x0 + i < view.width; ++i) out[i] = pixels[4 * row + i];
    }
  }
}

// Reads a sub-block of an image plane; pixels outside the image are 0.
static inline Float load_sub_block(const float* plane, const CameraView& view, int x0, int y0) {
  if (plane == nullptr) return Float{};
  alignas(64) float pixels[kLanes] = {};
  const bool whole = x0 + kSubWidth <= view.width && y0 + kSubHeight <= view.height;
  for (int row = 0; row < kSubHeight && (whole || y0 + row < view.height); ++row) {
    const float* in = plane + static_cast<std::size_t>(y0 + row) * view.width + x0;
    if (whole) {
      __builtin_memcpy(pixels + 4 * row, in, 4 * sizeof(float));
    } else {
      for (int i = 0; i < kSubWidth && x0 + i < view.width; ++i) pixels[4 * row + i] = in[i];
    }
  }
  return load(pixels);
}

static inline bool outside(const CameraView& view, int x0, int y0) { return x0 >= view.width || y0 >= view.height; }

// How many entries ahead a splat is asked for, and what its own line leads to: feature rows and gradient slots.
constexpr int kSplatPrefetch = 32, kRowPrefetch = 16;

static inline const float* feature_row(const GaussianArrays& arrays, std::int32_t gaussian) {
  return arrays.features + static_cast<std::size_t>(gaussian) * arrays.feature_channels;
}

// Always inline: GCC takes a function that only prefetches for one without effect and drops its calls.
#define GGSLAM_PREFETCHING static inline __attribute__((always_inline)) void

GGSLAM_PREFETCHING prefetch_features(const GaussianArrays& arrays, std::int32_t gaussian) {
  const float* row = feature_row(arrays, gaussian);
  for (int q = 0; q < arrays.feature_channels; q += 16) __builtin_prefetch(row + q);
  __builtin_prefetch(row + arrays.feature_channels - 1);  // a row may straddle one line more
}

// Copies the features of one Gaussian, padded with zeros to a multiple of 4.
static inline void copy_features(const GaussianArrays& arrays, std::int32_t gaussian, int padded, float* out) {
  const float* in = feature_row(arrays, gaussian);
  int q = 0;
  for (; q + 4 <= arrays.feature_channels; q += 4) __builtin_memcpy(out + q, in + q, 4 * sizeof(float));
  for (; q < padded; ++q) out[q] = q < arrays.feature_channels ? in[q] : 0.0f;
}

// Feature channels are handled in groups of as many as registers hold.
constexpr int kFeatureGroup = kLanes == 16 ? 16 : 8;

}  // namespace ggslam::GGSLAM_ISA
