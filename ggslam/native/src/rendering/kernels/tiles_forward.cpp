// SPDX-License-Identifier: Apache-2.0
// Compositing of one tile, front to back: sum over the depth-sorted splats of weight * (colour, depth, features) with
// weight = alpha * transmittance and transmittance *= 1 - alpha.
//
// Splats are taken in chunks of 64. For each chunk, the sub-blocks in turn keep their transmittance and base channels
// in registers while running over the chunk's splats that cover them. Feature channels follow in a second pass over
// the weights, as many at a time as registers hold.
#include "rendering/kernels/coverage.hpp"
#include "rendering/kernels/tile.hpp"
#include "rendering/kernels/tile_sort.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

enum BaseChannel { kRed, kGreen, kBlue, kDepth, kBaseChannels };

struct TileState {
  Float channels[kSubBlocks][kBaseChannels];
  Float transmittance[kSubBlocks], median_depth[kSubBlocks];
  Int last[kSubBlocks];   // number in the list of the last splat that contributed, -1 for none
  std::uint32_t alive;    // sub-blocks with a pixel that still takes splats
};

struct Chunk {
  Splat splats[kChunk];
  std::uint64_t covering[kSubBlocks];      // per sub-block, one bit per splat
  std::uint32_t contributed[kChunk];       // per splat, one bit per sub-block
  std::int32_t numbers[kChunk];            // of the splats in the tile's list
};

// The contributions to one sub-block: weights of the pixels and number of the splat in the chunk.
struct WeightList {
  Float weights[kChunk];
  std::int32_t splats[kChunk];
  int size;
};

GGSLAM_PREFETCHING prefetch_splat(const Rasterizer& r, std::uint32_t entry) {
  __builtin_prefetch(r.splats.data() + r.entries[entry].splat);
}

void find_covered(const Ellipses& ellipses, const Tile& tile, int n, std::uint32_t alive, std::uint64_t* covering) {
  alignas(64) std::uint32_t masks[kChunk];
  for (int k = 0; k < n; k += kLanes) {
    const Int covered = covered_sub_blocks(ellipses, k, tile) & static_cast<std::int32_t>(alive);
    store_int(reinterpret_cast<std::int32_t*>(masks) + k, covered);
  }
  for (int k = n; k < kChunk; ++k) masks[k] = 0;
  transpose_masks(masks, covering);
}

void load_chunk(const Rasterizer& r, const Tile& tile, std::uint32_t begin, int n, std::uint32_t alive,
                ThreadScratch& scratch, Chunk& chunk) {
  Ellipses ellipses;
  const std::int32_t first = static_cast<std::int32_t>(begin - tile.begin);
  for (int k = 0; k < kChunk; ++k) chunk.numbers[k] = first + k, chunk.contributed[k] = 0;
  for (int k = 0; k < n; ++k) {
    const Splat& splat = chunk.splats[k] = r.splats[r.entries[begin + k].splat];
    ellipses.set(k, splat);
    if (r.padded_features > 0) {
      // The splat's own line must have arrived before its features can be asked for: a shorter distance.
      if (begin + k + kRowPrefetch < tile.end)
        prefetch_features(r.gaussians, r.splats[r.entries[begin + k + kRowPrefetch].splat].gaussian);
      copy_features(r.gaussians, splat.gaussian, r.padded_features,
                    scratch.gaussian_features.data() + k * r.padded_features);
    }
  }
  const int whole = (n + kLanes - 1) / kLanes * kLanes;
  for (int k = n; k < whole; ++k) ellipses.set(k, chunk.splats[0]);
  find_covered(ellipses, tile, n, alive, chunk.covering);
}

// How a pixel ends. kPlain: with the Gaussian that takes it below `least`. k3dgs: that one is left out, as 3DGS does.
// kClosed: that one takes what is left. In the last two the sign of the transmittance says that the pixel has ended.
enum Ending { kPlain, k3dgs, kClosed };

template <bool kWithFeatures, bool kWithMedian, Ending kEnding>
inline void composite(const Tile& tile, Chunk& chunk, int s, float least, TileState& state, WeightList& list) {
  const Float x = tile.x[s], y = tile.y[s];
  Float t = state.transmittance[s], median = state.median_depth[s];
  Float red = state.channels[s][kRed], green = state.channels[s][kGreen], blue = state.channels[s][kBlue];
  Float depth = state.channels[s][kDepth];
  Int last = state.last[s];
  int size = 0;
  for (std::uint64_t left = chunk.covering[s]; left != 0; left &= left - 1) {
    const int k = __builtin_ctzll(left);
    const Splat& g = chunk.splats[k];
    const Float dy = y - g.mean_y;
    const Float exponent = log2_alpha(g, shear(g, x - g.mean_x, dy), dy);
    const Mask taken = both(greater_equal(exponent, broadcast(kLog2MinAlpha)),
                            greater_equal(t, broadcast(least)));
    const Float alpha =
        zero_unless(taken, minimum(exp2_unchecked(exponent), broadcast(kEnding == k3dgs ? kMaxAlphaOf3dgs : kMaxAlpha)));
    Float weight = alpha * t;
    const Float before = t;
    t = t - weight;
    if (kEnding == k3dgs) {
      const Mask closed = greater(broadcast(least), t);
      weight = select(closed, Float{}, weight);
      t = select(closed, -absolute(before), t);
    }
    if (kEnding == kClosed) {
      const Mask closed = both(taken, greater(broadcast(least), t));
      weight = select(closed, kMaxAlpha * before, weight);
      t = select(closed, (kMaxAlpha - 1.0f) * before, t);
    }
    red += weight * g.red;
    green += weight * g.green;
    blue += weight * g.blue;
    depth += weight * g.depth;
    last = select_int(taken, broadcast_int(chunk.numbers[k]), last);
    const bool contributes = any(taken);
    chunk.contributed[k] |= static_cast<std::uint32_t>(contributes) << s;
    if (kWithMedian) {
      const Mask crossed = both(greater_equal(before, broadcast(0.5f)), greater(broadcast(0.5f), t));
      median = select(crossed, broadcast(g.depth), median);
    }
    if (kWithFeatures) {
      list.weights[size] = weight;
      list.splats[size] = k;
      size += contributes;
    }
  }
  list.size = size;
  state.transmittance[s] = t;
  state.channels[s][kRed] = red, state.channels[s][kGreen] = green, state.channels[s][kBlue] = blue;
  state.channels[s][kDepth] = depth;
  state.last[s] = last;
  state.median_depth[s] = median;
}

// Adds weight * feature for kGroup channels. `sums` [kGroup][lanes], `features` the chunk's, from the first channel.
template <int kGroup>
inline void add_feature_group(const WeightList& list, const float* features, int stride, float* sums) {
  Float a[kGroup];
  for (int q = 0; q < kGroup; ++q) a[q] = load(sums + q * kLanes);
  for (int i = 0; i < list.size; ++i) {
    const Float weight = list.weights[i];
    const float* f = features + list.splats[i] * stride;
    for (int q = 0; q < kGroup; ++q) a[q] += weight * f[q];
  }
  for (int q = 0; q < kGroup; ++q) store(sums + q * kLanes, a[q]);
}

inline void add_features(const WeightList& list, const float* features, int channels, float* sums) {
  int q = 0;
  for (; q + kFeatureGroup <= channels; q += kFeatureGroup)
    add_feature_group<kFeatureGroup>(list, features + q, channels, sums + q * kLanes);
  for (; q + 8 <= channels; q += 8) add_feature_group<8>(list, features + q, channels, sums + q * kLanes);
  if (q < channels) add_feature_group<4>(list, features + q, channels, sums + q * kLanes);
}

template <bool kWithFeatures, bool kWithMedian, Ending kEnding = kPlain>
void composite_tile(Rasterizer& r, const Tile& tile, TileState& state, ThreadScratch& scratch) {
  constexpr std::uint32_t kShare = kChunk / kSubBlocks;
  Chunk chunk;
  WeightList list;
  const int channels = r.padded_features;
  const float least = kEnding == kClosed ? r.view.close_below : kMinTransmittance;
  for (std::uint32_t e = tile.begin; e < tile.end && e < tile.begin + kChunk; ++e) prefetch_splat(r, e);
  std::uint32_t begin = tile.begin;
  for (; begin < tile.end && state.alive != 0; begin += kChunk) {
    const int n = static_cast<int>(tile.end - begin < kChunk ? tile.end - begin : kChunk);
    load_chunk(r, tile, begin, n, state.alive, scratch, chunk);
    for (int s = 0; s < kSubBlocks; ++s) {
      // A share of the next chunk's splats at a time: asked for all at once they would wait for one another.
      for (std::uint32_t e = begin + kChunk + kShare * s; e < tile.end && e < begin + kChunk + kShare * (s + 1); ++e)
        prefetch_splat(r, e);
      if (chunk.covering[s] == 0) continue;
      composite<kWithFeatures, kWithMedian, kEnding>(tile, chunk, s, least, state, list);
      if (kWithFeatures)
        add_features(list, scratch.gaussian_features.data(), channels,
                     scratch.pixel_features.data() + s * channels * kLanes);
      if (!any(greater_equal(state.transmittance[s], broadcast(least)))) state.alive &= ~(1u << s);
    }
    __builtin_memcpy(r.contributed.data() + begin, chunk.contributed, sizeof(*chunk.contributed) * n);
  }
}

void start_tile(const Rasterizer& r, const Tile& tile, ThreadScratch& scratch, TileState& state) {
  state.alive = 0;
  for (int s = 0; s < kSubBlocks; ++s) {
    for (Float& channel : state.channels[s]) channel = Float{};
    // Pixels outside the image start opaque, so that they neither take nor keep alive anything.
    const Mask inside = both(greater(broadcast(static_cast<float>(r.view.width)), tile.x[s]),
                             greater(broadcast(static_cast<float>(r.view.height)), tile.y[s]));
    state.transmittance[s] = zero_unless(inside, broadcast(1.0f));
    state.median_depth[s] = Float{};
    state.last[s] = broadcast_int(-1);
    state.alive |= static_cast<std::uint32_t>(any(inside)) << s;
  }
  if (r.padded_features > 0)
    __builtin_memset(scratch.pixel_features.data(), 0, sizeof(float) * kSubBlocks * r.padded_features * kLanes);
}

void finish_tile(Rasterizer& r, int index, const Tile& tile, const TileState& state, const ThreadScratch& scratch,
                 const RenderTargets& targets) {
  const std::size_t pixels = static_cast<std::size_t>(r.view.width) * r.view.height;
  const std::size_t first = static_cast<std::size_t>(index) * kSubBlocks * kLanes;
  __builtin_memcpy(r.transmittance.data() + first, state.transmittance, sizeof(state.transmittance));
  __builtin_memcpy(r.last_entry.data() + first, state.last, sizeof(state.last));
  for (int s = 0; s < kSubBlocks; ++s) {
    const int x0 = sub_block_x(tile, s), y0 = sub_block_y(tile, s);
    if (outside(r.view, x0, y0)) continue;
    for (int k = 0; k < 3; ++k) store_sub_block(targets.image + k * pixels, r.view, x0, y0, state.channels[s][k]);
    store_sub_block(targets.depth, r.view, x0, y0, state.channels[s][kDepth]);
    store_sub_block(targets.alpha, r.view, x0, y0, 1.0f - absolute(state.transmittance[s]));
    if (targets.median_depth != nullptr)
      store_sub_block(targets.median_depth, r.view, x0, y0, state.median_depth[s]);
    if (r.padded_features == 0) continue;
    const float* sums = scratch.pixel_features.data() + s * r.padded_features * kLanes;
    for (int q = 0; q < r.gaussians.feature_channels; ++q)
      store_sub_block(targets.features + q * pixels, r.view, x0, y0, load(sums + q * kLanes));
  }
}

}  // namespace

void forward_tile(Rasterizer& r, int index, const RenderTargets& targets, ThreadScratch& scratch) {
  const Tile tile = make_tile(r, index);
  TileState state;
  start_tile(r, tile, scratch, state);
  sort_by_depth(r.entries.data() + tile.begin, scratch.sorting.data(), tile.end - tile.begin);
  const bool features = r.padded_features > 0, median = targets.median_depth != nullptr;
  const auto composite = r.as_3dgs                              ? composite_tile<false, false, k3dgs>
                         : r.view.close_below > 0 && features ? composite_tile<true, false, kClosed>
                         : r.view.close_below > 0             ? composite_tile<false, false, kClosed>
                         : features && median                 ? composite_tile<true, true>
                         : features                           ? composite_tile<true, false>
                         : median                             ? composite_tile<false, true>
                                                              : composite_tile<false, false>;
  composite(r, tile, state, scratch);
  finish_tile(r, index, tile, state, scratch, targets);
}

}  // namespace ggslam::GGSLAM_ISA
