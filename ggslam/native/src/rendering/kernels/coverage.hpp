// SPDX-License-Identifier: Apache-2.0
// The sub-blocks of a tile that splats cover: where alpha reaches 1/255 somewhere in the rectangle of a sub-block's
// pixel centres. One splat per lane.
//
// The ellipse of a splat is |conic_r| r^2 + |conic_y| dy^2 <= reach, r = dx - slope_x dy. Across a row of sub-blocks,
// a strip of dy, it extends to the right as far as slope_x dy + sqrt((reach - |conic_y| dy^2) / |conic_r|) does, which
// is highest at dy = turn, where the whole ellipse is rightmost, or else at that end of the strip which is nearer to
// it; to the left likewise at -turn. It is convex: it meets every sub-block of the row in between and no other.
#pragma once
#include "rendering/kernels/tile.hpp"

namespace ggslam::GGSLAM_ISA {

// Of a chunk's splats, what their ellipses take.
struct Ellipses {
  alignas(64) float mean_x[kChunk], mean_y[kChunk], slope_x[kChunk], conic_r[kChunk], conic_y[kChunk];
  alignas(64) float log2_opacity[kChunk], slope_y[kChunk];

  void set(int k, const Splat& g) {
    mean_x[k] = g.mean_x, mean_y[k] = g.mean_y, slope_x[k] = g.slope_x, conic_r[k] = g.conic_r, conic_y[k] = g.conic_y;
    log2_opacity[k] = g.log2_opacity, slope_y[k] = g.slope_y;
  }
};

// One bit per sub-block for each of the splats from `first` on.
static inline Int covered_sub_blocks(const Ellipses& e, int first, const Tile& tile) {
  constexpr float kMargin = 1e-3f, kPixelMargin = 1e-2f;  // so that rounding never drops a pixel
  constexpr float kColumns = static_cast<float>(kSubColumns), kPerPixel = 1.0f / kSubWidth;
  const Float slope = load(e.slope_x + first), conic_y = load(e.conic_y + first);
  const Float reach = load(e.log2_opacity + first) - (kLog2MinAlpha - kMargin);
  const Float wide2 = -1.0f / load(e.conic_r + first), high2 = -1.0f / conic_y;
  const Float highest = square_root(reach * high2);
  const Float turn = load(e.slope_y + first) * square_root(reach * (wide2 + slope * slope * high2));
  const Float origin_x = static_cast<float>(tile.x0) - load(e.mean_x + first);
  const Float origin_y = static_cast<float>(tile.y0) - load(e.mean_y + first);
  Int result{};
  for (int row = 0; row < kSubRows; ++row) {
    const Float begin = origin_y + static_cast<float>(row * kSubHeight);
    const Float low = maximum(begin, -highest), high = minimum(begin + static_cast<float>(kSubHeight - 1), highest);
    const Float right_y = clamp(turn, low, high), left_y = clamp(-turn, low, high);
    const Float right_r = square_root(maximum(reach + conic_y * right_y * right_y, Float{}) * wide2);
    const Float left_r = square_root(maximum(reach + conic_y * left_y * left_y, Float{}) * wide2);
    // In pixels from the tile's first one, then in sub-blocks: the first one and that behind the last one.
    const Float right = slope * right_y + right_r - origin_x, left = slope * left_y - left_r - origin_x;
    const Float from = clamp((left + (1.0f - kPixelMargin)) * kPerPixel, Float{}, broadcast(kColumns));
    const Float to = clamp((right + (kSubWidth + kPixelMargin)) * kPerPixel, from, broadcast(kColumns));
    const Int covered = power_of_two(truncate(to)) - power_of_two(truncate(from));
    result |= select_int(greater_equal(high, low), covered, Int{}) << (row * kSubColumns);
  }
  return result;
}

// masks[k] bit s -> transposed[s] bit k, for kChunk = 64 splats and 32 sub-blocks. `masks` is aligned to 64 bytes.
static inline void transpose_masks(const std::uint32_t* masks, std::uint64_t* transposed) {
  alignas(64) std::uint8_t bytes[4][kChunk];  // whose sign bits are packed; doubling brings the next bit to the sign
  for (int k = 0; k < kChunk; ++k)
    for (int b = 0; b < 4; ++b) bytes[b][k] = static_cast<std::uint8_t>(masks[k] >> (8 * b));
  for (int b = 0; b < 4; ++b) {
#if defined(__AVX512BW__)
    __m512i v = _mm512_load_si512(bytes[b]);
    for (int s = 8 * b + 7; s >= 8 * b; --s) {
      transposed[s] = _mm512_movepi8_mask(v);
      v = _mm512_add_epi8(v, v);
    }
#elif defined(__SSE2__)
    __m128i v[4];
    for (int i = 0; i < 4; ++i) v[i] = _mm_load_si128(reinterpret_cast<const __m128i*>(bytes[b] + 16 * i));
    for (int s = 8 * b + 7; s >= 8 * b; --s) {
      std::uint64_t found = 0;
      for (int i = 0; i < 4; ++i) {
        found |= static_cast<std::uint64_t>(static_cast<std::uint32_t>(_mm_movemask_epi8(v[i]))) << (16 * i);
        v[i] = _mm_add_epi8(v[i], v[i]);
      }
      transposed[s] = found;
    }
#else
    for (int s = 8 * b; s < 8 * b + 8; ++s) {
      std::uint64_t found = 0;
      for (int k = 0; k < kChunk; ++k) found |= static_cast<std::uint64_t>((bytes[b][k] >> (s & 7)) & 1) << k;
      transposed[s] = found;
    }
#endif
  }
}

}  // namespace ggslam::GGSLAM_ISA
