// SPDX-License-Identifier: Apache-2.0
// What compositing and its backward share: the layout of a tile, the exponent of a splat, sub-block masks.
//
// A tile is kTileWidth x kLanes pixels, cut into 4 x 4 sub-blocks of 4 x (kLanes / 4) pixels; one vector holds one
// sub-block, row by row.
#pragma once
#include "rendering/rasterizer.hpp"
#include "common/kernels/simd.hpp"

namespace ggslam::GGSLAM_ISA {

constexpr int kSubWidth = 4, kSubHeight = kLanes / 4;
constexpr int kTileHeight = 4 * kSubHeight;

struct Tile {
  int x0, y0;                    // its first pixel
  std::uint32_t begin, end;      // its entries
  Float x[kSubBlocks], y[kSubBlocks];  // pixel centres
};

static inline int sub_block_x(const Tile& tile, int s) { return tile.x0 + (s & 3) * kSubWidth; }
static inline int sub_block_y(const Tile& tile, int s) { return tile.y0 + (s >> 2) * kSubHeight; }

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

// log2 of alpha at the offsets (dx, dy) from the mean, before the limit kMaxAlpha.
static inline Float log2_alpha(const Splat& g, Float dx, Float dy) {
  return dx * (g.conic_xx * dx + g.conic_xy * dy) + (g.conic_yy * dy * dy + g.log2_opacity);
}

// The sub-blocks where a splat's alpha reaches 1/255 somewhere in the rectangle of the pixel centres, one bit each.
// Exact: the highest value over a rectangle lies at the mean if that is inside, else on one of the two sides facing
// it, at the point of that side where the quadratic is highest. Lanes are sub-blocks here.
static inline std::uint32_t covered_sub_blocks(const Splat& g, const Tile& tile) {
  constexpr float kMargin = 1e-3f;  // so that rounding never drops a pixel
  const Float threshold = broadcast(kLog2MinAlpha - kMargin - g.log2_opacity);
  const float origin_x = static_cast<float>(tile.x0) - g.mean_x, origin_y = static_cast<float>(tile.y0) - g.mean_y;
  std::uint32_t result = 0;
  for (int first = 0; first < kSubBlocks; first += kLanes) {
    Float column, row;
    for (int lane = 0; lane < kLanes; ++lane) {
      column[lane] = static_cast<float>(((first + lane) & 3) * kSubWidth);
      row[lane] = static_cast<float>(((first + lane) >> 2) * kSubHeight);
    }
    const Float low_x = column + origin_x, high_x = low_x + static_cast<float>(kSubWidth - 1);
    const Float low_y = row + origin_y, high_y = low_y + static_cast<float>(kSubHeight - 1);
    const Float near_x = clamp(Float{}, low_x, high_x), near_y = clamp(Float{}, low_y, high_y);
    const Float best_y = clamp(g.slope_y * near_x, low_y, high_y);  // on the vertical side facing the mean
    const Float best_x = clamp(g.slope_x * near_y, low_x, high_x);  // on the horizontal side
    const Float vertical = near_x * (g.conic_xx * near_x + g.conic_xy * best_y) + g.conic_yy * best_y * best_y;
    const Float horizontal = best_x * (g.conic_xx * best_x + g.conic_xy * near_y) + g.conic_yy * near_y * near_y;
    result |= bits(greater_equal(maximum(vertical, horizontal), threshold)) << first;
  }
  return result;
}

// masks[k] bit s -> transposed[s] bit k, for kChunk = 64 splats and 16 sub-blocks. `masks` is aligned to 64 bytes.
static inline void transpose_masks(const std::uint16_t* masks, std::uint64_t* transposed) {
#if defined(__AVX512BW__)
  const __m512i a = _mm512_load_si512(masks), b = _mm512_load_si512(masks + 32);
  for (int s = 0; s < kSubBlocks; ++s) {
    const __m512i bit = _mm512_set1_epi16(static_cast<short>(1u << s));
    transposed[s] = static_cast<std::uint64_t>(_mm512_test_epi16_mask(a, bit)) |
                    static_cast<std::uint64_t>(_mm512_test_epi16_mask(b, bit)) << 32;
  }
#elif defined(__SSE2__)
  // Packs the sign bits of 16 masks at a time; shifting left brings the next bit to the sign.
  __m128i v[8];
  for (int i = 0; i < 8; ++i) v[i] = _mm_load_si128(reinterpret_cast<const __m128i*>(masks + 8 * i));
  for (int s = kSubBlocks - 1; s >= 0; --s) {
    std::uint64_t bits = 0;
    for (int i = 0; i < 4; ++i) {
      const __m128i bytes = _mm_packs_epi16(_mm_srai_epi16(v[2 * i], 15), _mm_srai_epi16(v[2 * i + 1], 15));
      bits |= static_cast<std::uint64_t>(static_cast<std::uint32_t>(_mm_movemask_epi8(bytes))) << (16 * i);
    }
    transposed[s] = bits;
    for (int i = 0; i < 8; ++i) v[i] = _mm_slli_epi16(v[i], 1);
  }
#else
  for (int s = 0; s < kSubBlocks; ++s) {
    std::uint64_t bits = 0;
    for (int k = 0; k < kChunk; ++k) bits |= static_cast<std::uint64_t>((masks[k] >> s) & 1) << k;
    transposed[s] = bits;
  }
#endif
}

// The inverse of transpose_masks.
static inline void transpose_masks_back(const std::uint64_t* transposed, std::uint16_t* masks) {
#if defined(__AVX512BW__)
  __m512i a = _mm512_setzero_si512(), b = a;
  for (int s = 0; s < kSubBlocks; ++s) {
    const __m512i bit = _mm512_set1_epi16(static_cast<short>(1u << s));
    a = _mm512_or_si512(a, _mm512_maskz_mov_epi16(static_cast<__mmask32>(transposed[s]), bit));
    b = _mm512_or_si512(b, _mm512_maskz_mov_epi16(static_cast<__mmask32>(transposed[s] >> 32), bit));
  }
  _mm512_store_si512(masks, a);
  _mm512_store_si512(masks + 32, b);
#else
  __builtin_memset(masks, 0, sizeof(*masks) * kChunk);
  for (int s = 0; s < kSubBlocks; ++s)
    for (std::uint64_t left = transposed[s]; left != 0; left &= left - 1)
      masks[__builtin_ctzll(left)] |= static_cast<std::uint16_t>(1u << s);
#endif
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
