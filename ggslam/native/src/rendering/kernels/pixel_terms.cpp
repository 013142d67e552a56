// SPDX-License-Identifier: Apache-2.0
// Composites single pixels of a tile once more, a vector of any pixels at a time, and notes every contribution; or all of
// its pixels, and notes which Gaussians contribute.
#include "rendering/pixel_terms.hpp"

#include "rendering/kernels/tile.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

struct Lanes {
  Float x, y;
  Int last;                       // number in the tile's list of the last contribution, -1 beyond the last pixel
  Int closing;                    // the same of pixels that were closed, else kNever
  std::int32_t rows[kLanes];
  std::int32_t sizes[kLanes];
  std::uint32_t sub_blocks = 0;   // that the pixels lie in
  std::int32_t last_of_all = -1;
};

Lanes gather_lanes(const Rasterizer& r, int tile, const TermPixel* pixels, int n) {
  Lanes lanes;
  lanes.x = lanes.y = Float{};
  lanes.last = broadcast_int(-1);
  lanes.closing = broadcast_int(kNever);
  for (int lane = 0; lane < n; ++lane) {
    const TermPixel& p = pixels[lane];
    const std::size_t at = (static_cast<std::size_t>(tile) * kSubBlocks + p.sub_block) * kLanes + p.lane;
    const std::int32_t last = r.last_entry[at];
    lanes.x[lane] = static_cast<float>(p.x);
    lanes.y[lane] = static_cast<float>(p.y);
    lanes.last[lane] = last;
    if (r.transmittance[at] < 0) lanes.closing[lane] = last;
    lanes.rows[lane] = p.row;
    lanes.sizes[lane] = 0;
    lanes.sub_blocks |= 1u << p.sub_block;
    lanes.last_of_all = last > lanes.last_of_all ? last : lanes.last_of_all;
  }
  return lanes;
}

// One splat's alpha at the pixels of a vector: 0 beyond the last contribution of a pixel.
inline Float alpha_at(const Splat& g, Float x, Float y, Int last, Int closing, std::int32_t k, Mask& taken) {
  const Float dy = y - g.mean_y;
  const Float exponent = log2_alpha(g, shear(g, x - g.mean_x, dy), dy);
  taken = both(greater_equal(exponent, broadcast(kLog2MinAlpha)), greater_equal_int(last, broadcast_int(k)));
  const Float own = minimum(exp2_unchecked(exponent), broadcast(kMaxAlpha));
  return zero_unless(taken, select(greater_equal_int(broadcast_int(k), closing), broadcast(kMaxAlpha), own));
}

void walk(const Rasterizer& r, int tile, Lanes& lanes, float min_weight, const PixelTerms& out) {
  const TileEntry* entries = r.entries.data() + r.tile_start[tile];
  const std::uint32_t* contributed = r.contributed.data() + r.tile_start[tile];
  Float t = broadcast(1.0f);
  for (std::int32_t k = 0; k <= lanes.last_of_all; ++k) {
    if (k + kSplatPrefetch <= lanes.last_of_all && (contributed[k + kSplatPrefetch] & lanes.sub_blocks) != 0)
      __builtin_prefetch(r.splats.data() + entries[k + kSplatPrefetch].splat);
    if ((contributed[k] & lanes.sub_blocks) == 0) continue;
    const Splat& g = r.splats[entries[k].splat];
    Mask taken;
    const Float alpha = alpha_at(g, lanes.x, lanes.y, lanes.last, lanes.closing, k, taken);
    const Float weight = alpha * t;
    t = t - weight;
    std::uint32_t wanted = bits(both(taken, greater_equal(weight, broadcast(min_weight))));
    for (; wanted != 0; wanted &= wanted - 1) {
      const int lane = __builtin_ctz(wanted);
      const std::int32_t size = lanes.sizes[lane];
      if (size == out.capacity) continue;
      const std::size_t at = static_cast<std::size_t>(lanes.rows[lane]) * out.capacity + size;
      out.gaussians[at] = g.gaussian;
      out.weights[at] = weight[lane];
      lanes.sizes[lane] = size + 1;
    }
  }
}

}  // namespace

void collect_terms(const Rasterizer& r, int tile, const TermPixel* pixels, int count, float min_weight,
                   const PixelTerms& out) {
  for (int first = 0; first < count; first += kLanes) {
    const int n = count - first < kLanes ? count - first : kLanes;
    Lanes lanes = gather_lanes(r, tile, pixels + first, n);
    walk(r, tile, lanes, min_weight, out);
    for (int lane = 0; lane < n; ++lane) out.counts[lanes.rows[lane]] = lanes.sizes[lane];
  }
}

void mark_shown(const Rasterizer& r, int index, float min_weight, std::uint8_t* shown) {
  const Tile tile = make_tile(r, index);
  Float t[kSubBlocks];
  Int last[kSubBlocks], closing[kSubBlocks];
  std::int32_t last_of_all = -1;
  for (int s = 0; s < kSubBlocks; ++s) {
    const std::size_t at = (static_cast<std::size_t>(index) * kSubBlocks + s) * kLanes;
    t[s] = broadcast(1.0f);
    for (int lane = 0; lane < kLanes; ++lane) {
      const bool outside =
          sub_block_x(tile, s) + (lane & 3) >= r.view.width || sub_block_y(tile, s) + (lane >> 2) >= r.view.height;
      const std::int32_t end = outside ? -1 : r.last_entry[at + lane];
      last[s][lane] = end;
      closing[s][lane] = !outside && r.transmittance[at + lane] < 0 ? end : kNever;
      last_of_all = end > last_of_all ? end : last_of_all;
    }
  }
  const TileEntry* entries = r.entries.data() + tile.begin;
  const std::uint32_t* contributed = r.contributed.data() + tile.begin;
  for (std::int32_t k = 0; k <= last_of_all; ++k) {
    if (k + kSplatPrefetch <= last_of_all) __builtin_prefetch(r.splats.data() + entries[k + kSplatPrefetch].splat);
    const Splat& g = r.splats[entries[k].splat];
    bool seen = false;
    for (std::uint32_t left = contributed[k]; left != 0; left &= left - 1) {
      const int s = __builtin_ctz(left);
      Mask taken;
      const Float weight = alpha_at(g, tile.x[s], tile.y[s], last[s], closing[s], k, taken) * t[s];
      t[s] = t[s] - weight;
      seen |= any(both(taken, greater_equal(weight, broadcast(min_weight))));
    }
    if (seen) __atomic_store_n(shown + g.gaussian, std::uint8_t{1}, __ATOMIC_RELAXED);  // other tiles may mark it, too
  }
}

}  // namespace ggslam::GGSLAM_ISA
