// SPDX-License-Identifier: Apache-2.0
// From Gaussians to splats: project, drop what cannot be seen, count the tiles that each one covers.
#include "rendering/kernels/projection_math.hpp"
#include "rendering/kernels/tile_layout.hpp"
#include "rendering/kernels/tile_rectangle.hpp"
#include "rendering/kernels/view_colour.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

// The splats of one vector of Gaussians.
struct SplatVectors {
  alignas(64) float fields[3][4][kLanes];  // the first twelve numbers of a Splat, see `splat_fields`
  alignas(64) std::int32_t corners[kLanes], sizes[kLanes];  // TileRectangle, two 16-bit numbers each
  std::uint32_t visible;  // one bit per lane
};

// Four of a splat's numbers.
inline const float* splat_fields(const SplatVectors& v, int four, int lane) {
  return v.fields[four][lane % 4] + lane / 4 * 4;
}

// Whether any Gaussian may reach into the image, by its mean and its largest scale alone: most of a large map does not.
// An ellipse extends by less than 3.34 standard deviations (alpha falls from 1 to 1/255), and those in the image are at
// most scale * focal length / z * |(1, slope)|, besides the low-pass filter's. Everything is multiplied by z.
inline bool may_be_seen(const ViewConstants& c, const CameraView& view, const RawGaussian& g) {
  constexpr float kDeviations = 3.34f;
  Float p[3];
  for (int i = 0; i < 3; ++i)
    p[i] = c.W[i][0] * g.mean[0] + (c.W[i][1] * g.mean[1] + (c.W[i][2] * g.mean[2] + c.t[i]));
  const Float scale = exponential(maximum(maximum(g.log_scale[0], g.log_scale[1]), g.log_scale[2]));
  const float filter = kDeviations * __builtin_sqrtf(c.low_pass) + 1.0f;  // and a pixel to spare
  const auto slope = [](float low, float high) { return __builtin_sqrtf(1.0f + low * low + high * high); };
  const Float around_x = kDeviations * c.fx * slope(c.min_u, c.max_u) * scale + filter * p[2];
  const Float around_y = kDeviations * c.fy * slope(c.min_v, c.max_v) * scale + filter * p[2];
  const Float x = c.fx * p[0] + c.cx * p[2], y = c.fy * p[1] + c.cy * p[2];
  const float width = static_cast<float>(view.width), height = static_cast<float>(view.height);
  const Mask in_x = both(greater_equal(x + around_x, Float{}), greater_equal(width * p[2] + around_x, x));
  const Mask in_y = both(greater_equal(y + around_y, Float{}), greater_equal(height * p[2] + around_y, y));
  return any(both(greater_equal(p[2], broadcast(c.near_plane)), both(in_x, in_y)));
}

// Tiles from first to last that the pixels within `extent` of `centre` fall in; false where there is no pixel.
inline Mask tile_range(Float centre, Float extent, int size, int tile_size, Int& first, Int& last) {
  const Float limit = broadcast(static_cast<float>(size - 1));
  const Float low = maximum(centre - extent, broadcast(0.0f)), high = minimum(centre + extent, limit);
  // Rounds low up and high down to pixel centres. Lanes outside the image are clamped first and masked after.
  const Int floor_low = truncate(minimum(low, limit));
  const Int first_pixel = select_int(greater(low, to_float(floor_low)), floor_low + 1, floor_low);
  const Int last_pixel = truncate(maximum(high, broadcast(0.0f)));
  const int shift = __builtin_ctz(tile_size);
  first = first_pixel >> shift;
  last = last_pixel >> shift;
  const Mask inside = both(greater_equal(high, broadcast(0.0f)), greater_equal(limit, low));
  return both(inside, greater_equal_int(last_pixel, first_pixel));
}

inline Float black_or_more(Float colour) { return maximum(colour, Float{}); }

inline void make_splats(const Rasterizer& r, const ViewConstants& c, const Rows& rows, SplatVectors& out) {
  const RawGaussian g = load_gaussians(r.gaussians, rows);
  out.visible = 0;
  if (!may_be_seen(c, r.view, g)) return;
  const Projection p = project(c, g);
  const Float log2_opacity = -log2(1.0f + exp2(-kLog2E * g.opacity_logit));
  // alpha >= 1/255 inside the ellipse d^T cov^-1 d <= 2 ln(255 opacity); a hair larger, so that rounding here never
  // decides which pixels are in.
  const Float radius2 = 2.0f * kLn2 * (log2_opacity - kLog2MinAlpha) + 2e-3f;
  Mask ok = both(renderable(c, g, p), greater_equal(log2_opacity, broadcast(kLog2MinAlpha)));
  Float colour[3];
  view_colour(r.gaussians, c, rows, p.position, colour);
  const Float brightness = absolute(colour[0]) + absolute(colour[1]) + absolute(colour[2]);
  ok = both(ok, greater_equal(broadcast(1e30f), brightness));  // false for NaN
  const Float safe = zero_unless(ok, radius2);
  const Float mean_x = c.fx * p.u + c.cx, mean_y = c.fy * p.v + c.cy;
  Int x0, x1, y0, y1;
  ok = both(ok, tile_range(mean_x, square_root(safe * p.cov_xx), r.view.width, kTileWidth, x0, x1));
  ok = both(ok, tile_range(mean_y, square_root(safe * p.cov_yy), r.view.height, kTileHeight, y0, y1));
  out.visible = bits(ok) & ((1u << rows.n) - 1);
  store_int(out.corners, x0 | y0 << 16);
  store_int(out.sizes, (x1 - x0 + 1) | (y1 - y0 + 1) << 16);

  Float fields[3][4] = {
      {mean_x, mean_y, p.slope, -0.5f * kLog2E * p.conic_r},
      {-0.5f * kLog2E * p.conic_y, log2_opacity, black_or_more(colour[0]), black_or_more(colour[1])},
      {black_or_more(colour[2]), p.position[2], p.cov_xy / p.cov_xx, Float{}}};
  for (int four = 0; four < 3; ++four) {
    transpose_fours(fields[four]);
    for (int k = 0; k < 4; ++k) store(out.fields[four][k], fields[four][k]);
  }
}

inline void write_splat(const SplatVectors& v, int lane, std::int32_t gaussian, std::uint32_t first_pair, Splat& splat,
                        Footprint& footprint) {
  for (int four = 0; four < 3; ++four)
    __builtin_memcpy(&splat.mean_x + 4 * four, splat_fields(v, four, lane), 4 * sizeof(float));
  __builtin_memcpy(&splat.tiles.x, &v.corners[lane], sizeof(std::int32_t));
  __builtin_memcpy(&splat.tiles.wide, &v.sizes[lane], sizeof(std::int32_t));
  splat.gaussian = gaussian;
  splat.first_pair = first_pair;
  footprint.tiles = splat.tiles;
  __builtin_memcpy(&footprint.depth_bits, splat_fields(v, 2, lane) + 1, sizeof(float));
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
  Rows rows;
  rows.count = r.gaussians.count;
  for (std::int64_t i = begin; i < end; i += kLanes) {
    rows.n = static_cast<int>(end - i < kLanes ? end - i : kLanes);
    for (int lane = 0; lane < kLanes; ++lane)
      rows.numbers[lane] = static_cast<std::int32_t>(lane < rows.n ? i + lane : i);
    make_splats(r, c, rows, v);
    for (std::uint32_t left = v.visible; left != 0; left &= left - 1) {
      const int lane = __builtin_ctz(left);
      write_splat(v, lane, rows.numbers[lane], static_cast<std::uint32_t>(pairs), *splat, *footprint);
      const TileRectangle tiles = footprint->tiles;
      pairs += static_cast<std::uint64_t>(tiles.wide) * tiles.high;
      visit_tiles(tiles, tiles_x, spare, [counts](int tile, int) { ++counts[tile]; });
      ++splat;
      ++footprint;
    }
  }
  r.visible[block] = static_cast<std::int32_t>(splat - (r.splats.data() + begin));
  r.pairs[block] = pairs;
}

}  // namespace ggslam::GGSLAM_ISA
