// SPDX-License-Identifier: Apache-2.0
// From Gaussians to splats: project, drop what cannot be seen, count the tiles that each one covers.
#include "rendering/kernels/projection_math.hpp"
#include "rendering/kernels/tile_layout.hpp"
#include "rendering/kernels/tile_rectangle.hpp"
#include "rendering/kernels/view_colour.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

// The splats of one vector of Gaussians, field by field.
struct SplatVectors {
  enum Field { kMeanX, kMeanY, kSlopeX, kConicR, kConicY, kLog2Opacity, kRed, kGreen, kBlue, kDepth, kSlopeY, kFields };
  alignas(64) float fields[kFields][kLanes];
  alignas(64) std::int32_t tile_x0[kLanes], tile_x1[kLanes], tile_y0[kLanes], tile_y1[kLanes];  // inclusive
  std::uint32_t visible;  // one bit per lane
};

// Tiles from first to last that the pixels within `extent` of `centre` fall in; false where there is no pixel.
inline Mask tile_range(Float centre, Float extent, int size, int tile_size, std::int32_t* first, std::int32_t* last) {
  const Float limit = broadcast(static_cast<float>(size - 1));
  const Float low = maximum(centre - extent, broadcast(0.0f)), high = minimum(centre + extent, limit);
  // Rounds low up and high down to pixel centres. Lanes outside the image are clamped first and masked after.
  const Int floor_low = truncate(minimum(low, limit));
  const Int first_pixel = select_int(greater(low, to_float(floor_low)), floor_low + 1, floor_low);
  const Int last_pixel = truncate(maximum(high, broadcast(0.0f)));
  const int shift = __builtin_ctz(tile_size);
  store_int(first, first_pixel >> shift);
  store_int(last, last_pixel >> shift);
  const Mask inside = both(greater_equal(high, broadcast(0.0f)), greater_equal(limit, low));
  return both(inside, greater_equal_int(last_pixel, first_pixel));
}

inline Float black_or_more(Float colour) { return maximum(colour, Float{}); }

inline void make_splats(const Rasterizer& r, const ViewConstants& c, const std::int32_t* rows, int n,
                        SplatVectors& out) {
  const RawGaussians g = load_gaussians(r.gaussians, rows, n);
  const Projection p = project(c, g);
  const Float log2_opacity = -log2(1.0f + exp2(-kLog2E * g.opacity_logit));
  // alpha >= 1/255 inside the ellipse d^T cov^-1 d <= 2 ln(255 opacity); a hair larger, so that rounding here never
  // decides which pixels are in.
  const Float radius2 = 2.0f * kLn2 * (log2_opacity - kLog2MinAlpha) + 2e-3f;
  Mask ok = both(renderable(c, g, p), greater_equal(log2_opacity, broadcast(kLog2MinAlpha)));
  Float colour[3];
  view_colour(r.gaussians, c, rows, n, p.position, colour);
  const Float brightness = absolute(colour[0]) + absolute(colour[1]) + absolute(colour[2]);
  ok = both(ok, greater_equal(broadcast(1e30f), brightness));  // false for NaN
  const Float safe = zero_unless(ok, radius2);
  const Float mean_x = c.fx * p.u + c.cx, mean_y = c.fy * p.v + c.cy;
  ok = both(ok, tile_range(mean_x, square_root(safe * p.cov_xx), r.view.width, kTileWidth, out.tile_x0, out.tile_x1));
  ok = both(ok, tile_range(mean_y, square_root(safe * p.cov_yy), r.view.height, kTileHeight, out.tile_y0, out.tile_y1));
  out.visible = bits(ok) & ((1u << n) - 1);

  const Float values[SplatVectors::kFields] = {
      mean_x, mean_y, p.slope, -0.5f * kLog2E * p.conic_r, -0.5f * kLog2E * p.conic_y, log2_opacity,
      black_or_more(colour[0]), black_or_more(colour[1]), black_or_more(colour[2]), p.position[2], p.cov_xy / p.cov_xx};
  for (int k = 0; k < SplatVectors::kFields; ++k) store(out.fields[k], values[k]);
}

inline TileRectangle tile_rectangle(const SplatVectors& v, int lane) {
  const int x = v.tile_x0[lane], y = v.tile_y0[lane];
  return {static_cast<std::uint16_t>(x), static_cast<std::uint16_t>(y),
          static_cast<std::uint16_t>(v.tile_x1[lane] - x + 1), static_cast<std::uint16_t>(v.tile_y1[lane] - y + 1)};
}

}  // namespace

TileLayout tile_layout() { return {kLanes, kTileWidth, kTileHeight}; }

void project_block(Rasterizer& r, int block) {
  const ViewConstants c = view_constants(r.view);
  std::uint32_t* counts = r.cursors(block);
  __builtin_memset(counts, 0, sizeof(*counts) * (r.tiles() + 1));
  const int tiles_x = r.tiles_x, spare = r.tiles();
  const std::int64_t begin = r.block_begin(block), end = r.block_end(block);
  Splat* splat = r.splats.data() + begin;
  Footprint* footprint = r.footprints.data() + begin;
  std::uint64_t pairs = 0;
  SplatVectors v;
  std::int32_t rows[kLanes];
  for (std::int64_t i = begin; i < end; i += kLanes) {
    const int n = static_cast<int>(end - i < kLanes ? end - i : kLanes);
    for (int lane = 0; lane < kLanes; ++lane) rows[lane] = static_cast<std::int32_t>(i) + lane;
    make_splats(r, c, rows, n, v);
    for (std::uint32_t left = v.visible; left != 0; left &= left - 1) {
      const int lane = __builtin_ctz(left);
      float* fields = &splat->mean_x;  // the first eleven floats of a splat, in the order of SplatVectors::Field
      for (int k = 0; k < SplatVectors::kFields; ++k) fields[k] = v.fields[k][lane];
      const TileRectangle tiles = tile_rectangle(v, lane);
      splat->first_pair = static_cast<std::uint32_t>(pairs);
      splat->gaussian = rows[lane];
      splat->tiles = footprint->tiles = tiles;
      __builtin_memcpy(&footprint->depth_bits, &splat->depth, sizeof(float));
      ++footprint;
      pairs += static_cast<std::uint64_t>(tiles.wide) * tiles.high;
      visit_tiles(tiles, tiles_x, spare, [counts](int tile, int) { ++counts[tile]; });
      ++splat;
    }
  }
  r.visible[block] = static_cast<std::int32_t>(splat - (r.splats.data() + begin));
  r.pairs[block] = pairs;
}

}  // namespace ggslam::GGSLAM_ISA
