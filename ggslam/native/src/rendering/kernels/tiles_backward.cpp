// SPDX-License-Identifier: Apache-2.0
// Backward of compositing one tile, back to front. With g = sum over channels of channel value times image gradient at
// a pixel, t the transmittance before the splat and "behind" the sum of weight * g over all splats behind it (starting
// from minus the final transmittance times the gradient of the alpha image):
//     d loss / d alpha = t g - behind / (1 - alpha)
// so one scalar per pixel stands for everything behind. With t' = (1 - alpha) t, the transmittance after the splat, and
// the odds o = alpha / (1 - alpha):
//     weight = alpha t = o t',   t = t' + weight,   G := alpha d loss / d alpha = o (t' g - behind).
//
// G, d loss / d log(alpha), leads to the splat's geometry through its moments sum G (1, r, dy, r^2, r dy, dy^2), r as
// in the splat. The sums over the tile's pixels go to the pair's own slot; gather.cpp adds up a Gaussian's slots.
//
// Splats are taken in chunks, from the last one of the tile. First the sub-blocks in turn keep what they know of their
// pixels in registers while running over the chunk's splats that contributed to them, and write down G and the weight;
// then the splats in turn add these up in registers. Neither loop has so many values at hand that 16 registers would
// not do, and the first one, unlike one over a single splat's sub-blocks, is long enough to be foreseen.
#include "rendering/kernels/coverage.hpp"
#include "rendering/kernels/tile.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

// alpha / (1 - alpha) at the limit, less what rounding may do.
constexpr float kOddsAtLimit = 0.9999f * kMaxAlpha / (1.0f - kMaxAlpha);

enum FeatureMode { kNoFeatures, kFeaturesReachGeometry, kFeaturesDetached };

struct TileGradients {
  Float channels[kSubBlocks][4];                   // image gradients: red, green, blue, depth
  Float transmittance[kSubBlocks], behind[kSubBlocks];
  Int last[kSubBlocks];
  Int closing[kSubBlocks];                         // the same of pixels that were closed, else kNever
  std::int32_t last_in_tile;                       // highest entry that contributed anywhere
};

// What came of one splat in one sub-block.
struct Contribution {
  Float gradient, weight;  // G; before it is known, the dot product of features and image gradients
};

// Contributions lie splat by splat and, within a splat, in the order of the sub-blocks.
struct Chunk {
  Splat splats[kChunk];
  std::size_t pairs[kChunk];
  std::uint32_t contributed[kChunk];             // one bit per sub-block
  std::uint64_t contributing[kSubBlocks];        // the same, per sub-block
  std::int32_t first[kChunk + 1];                // number of a splat's first contribution
  std::int32_t next[kChunk];                     // of its next one while they are written
  std::int32_t numbers[kChunk];                  // of the splats in the tile's list
  std::uint8_t sub_blocks[kChunk * kSubBlocks];  // of the contributions
  Contribution* contributions;
};

// alpha / (1 - alpha), 0 for 0.
inline Float odds(Float alpha) {
#if defined(__AVX512F__)
  return alpha * reciprocal(1.0f - alpha);
#else
  return alpha / (1.0f - alpha);
#endif
}

void load_gradients(const Rasterizer& r, int index, const Tile& tile, const ImageGradients& in, ThreadScratch& scratch,
                    TileGradients& out) {
  const std::size_t pixels = static_cast<std::size_t>(r.view.width) * r.view.height;
  const std::size_t first = static_cast<std::size_t>(index) * kSubBlocks * kLanes;
  const float* image[4] = {in.image, in.image ? in.image + pixels : nullptr, in.image ? in.image + 2 * pixels : nullptr,
                           in.depth};
  out.last_in_tile = -1;
  for (int s = 0; s < kSubBlocks; ++s) {
    const int x0 = sub_block_x(tile, s), y0 = sub_block_y(tile, s);
    const bool drop = outside(r.view, x0, y0);
    for (int k = 0; k < 4; ++k) out.channels[s][k] = drop ? Float{} : load_sub_block(image[k], r.view, x0, y0);
    const Float transmittance = load(r.transmittance.data() + first + s * kLanes);
    out.transmittance[s] = absolute(transmittance);
    out.last[s] = load_int(r.last_entry.data() + first + s * kLanes);
    out.closing[s] = select_int(greater(Float{}, transmittance), out.last[s], broadcast_int(kNever));
    const Float alpha = drop ? Float{} : load_sub_block(in.alpha, r.view, x0, y0);
    out.behind[s] = -out.transmittance[s] * alpha;
    for (int lane = 0; lane < kLanes; ++lane)
      out.last_in_tile = out.last[s][lane] > out.last_in_tile ? out.last[s][lane] : out.last_in_tile;
    float* features = scratch.pixel_features.data() + s * r.padded_features * kLanes;
    for (int q = 0; q < r.padded_features; ++q) {
      const bool zero = drop || in.features == nullptr || q >= r.gaussians.feature_channels;
      const float* plane = zero ? nullptr : in.features + q * pixels;
      store(features + q * kLanes, load_sub_block(plane, r.view, x0, y0));
    }
  }
}

// dots[s] += sum of feature times image gradient over kGroup channels, for the sub-blocks in the mask. Features stay
// in registers; only the image gradients are loaded.
template <int kGroup>
inline void add_feature_dots(std::uint32_t sub_blocks, const float* features, const float* pixel_features, int channels,
                             Float* dots) {
  Float f[kGroup];
  for (int q = 0; q < kGroup; ++q) f[q] = broadcast(features[q]);
  for (; sub_blocks != 0; sub_blocks &= sub_blocks - 1) {
    const int s = __builtin_ctz(sub_blocks);
    const float* v = pixel_features + s * channels * kLanes;
    Float a = dots[s], b = {};  // two sums, for shorter waits
    for (int q = 0; q < kGroup; q += 2) {
      a += f[q] * load(v + q * kLanes);
      b += f[q + 1] * load(v + (q + 1) * kLanes);
    }
    dots[s] = a + b;
  }
}

inline void feature_dots(std::uint32_t sub_blocks, const float* features, const float* pixel_features, int channels,
                         Float* dots) {
  for (std::uint32_t left = sub_blocks; left != 0; left &= left - 1) dots[__builtin_ctz(left)] = Float{};
  int q = 0;
  for (; q + kFeatureGroup <= channels; q += kFeatureGroup)
    add_feature_dots<kFeatureGroup>(sub_blocks, features + q, pixel_features + q * kLanes, channels, dots);
  for (; q + 8 <= channels; q += 8)
    add_feature_dots<8>(sub_blocks, features + q, pixel_features + q * kLanes, channels, dots);
  if (q < channels) add_feature_dots<4>(sub_blocks, features + q, pixel_features + q * kLanes, channels, dots);
}

// The splats that contributed to one sub-block, from the last one, and their exponents, then odds alpha / (1 - alpha).
struct Stage {
  std::uint8_t splats[kChunk];  // numbers in the chunk
  Float values[kChunk + 3];
};

// Exponents, very low where the splat was not taken; returns the number of splats.
inline int find_exponents(const Tile& tile, int s, const Chunk& chunk, const TileGradients& grad, Stage& stage) {
  const Float x = tile.x[s], y = tile.y[s];
  const Int last = grad.last[s], closing = grad.closing[s];
  int n = 0;
  for (std::uint64_t left = chunk.contributing[s]; left != 0; ++n) {
    const int k = 63 - __builtin_clzll(left);
    left &= ~(std::uint64_t{1} << k);
    stage.splats[n] = static_cast<std::uint8_t>(k);
    const Splat& g = chunk.splats[k];
    const Float dy = y - g.mean_y, r = shear(g, x - g.mean_x, dy);
    const Int number = broadcast_int(chunk.numbers[k]);
    // The splat that closed a pixel counts as one of full opacity, to which the limit kMaxAlpha applies.
    const Float exponent = select(greater_equal_int(number, closing), Float{}, log2_alpha(g, r, dy));
    stage.values[n] = select(greater_equal_int(last, number), exponent, broadcast(-200.0f));
  }
  return n;
}

// Four at a time, so that the processor finds enough to do while it waits; what is there beyond n does not matter.
inline void find_odds(int n, Float* values) {
  for (int first = 0; first < n; first += 4)
    for (int i = first; i < first + 4; ++i) {
      const Float exponent = values[i];
      const Mask taken = greater_equal(exponent, broadcast(kLog2MinAlpha));
      const Float alpha = minimum(zero_unless(taken, exp2_unchecked(exponent)), broadcast(kMaxAlpha));
      values[i] = odds(alpha);
    }
}

// G and weights of the chunk's splats in one sub-block.
template <FeatureMode kMode>
inline void differentiate_sub_block(const Tile& tile, int s, Chunk& chunk, TileGradients& grad, Stage& stage) {
  const int n = find_exponents(tile, s, chunk, grad, stage);
  find_odds(n, stage.values);
  const Float red = grad.channels[s][0], green = grad.channels[s][1];
  const Float blue = grad.channels[s][2], depth = grad.channels[s][3];
  Float t = grad.transmittance[s], behind = grad.behind[s];
  for (int i = 0; i < n; ++i) {
    const int k = stage.splats[i];
    const Splat& g = chunk.splats[k];
    const int place = chunk.next[k]++;
    Contribution& out = chunk.contributions[place];
    chunk.sub_blocks[place] = static_cast<std::uint8_t>(s);
    Float dot = g.red * red + g.green * green + g.blue * blue + g.depth * depth;
    if (kMode == kFeaturesReachGeometry) dot += out.gradient;
    // Where the splat was not taken the odds are 0, and so is all that follows from them.
    const Float odds = stage.values[i], weight = odds * t, G = odds * (t * dot - behind);
    t = t + weight;
    behind = behind + weight * dot;
    // At the limit kMaxAlpha, alpha does not depend on the splat's shape.
    out.gradient = zero_unless(greater(broadcast(kOddsAtLimit), odds), G);
    out.weight = weight;
  }
  grad.transmittance[s] = t;
  grad.behind[s] = behind;
}

// One line, past the caches, which have no room for all slots until they are read: then it need not be fetched first.
inline void write_slot(const float* sums, float* slot) {
#if defined(__AVX512F__)
  _mm512_stream_ps(slot, _mm512_load_ps(sums));
#elif defined(__AVX2__)
  _mm256_stream_ps(slot, _mm256_load_ps(sums));
  _mm256_stream_ps(slot + 8, _mm256_load_ps(sums + 8));
#elif defined(__SSE2__)
  for (int q = 0; q < kSlotStride; q += 4) _mm_stream_ps(slot + q, _mm_load_ps(sums + q));
#else
  __builtin_memcpy(slot, sums, sizeof(float) * kSlotStride);
#endif
}

// Other threads may read the slots from now on.
inline void finish_slots() {
#if defined(__SSE2__)
  _mm_sfence();
#endif
}

// The sums over a splat's sub-blocks.
inline void sum_splat(const Tile& tile, const Chunk& chunk, int k, const TileGradients& grad, float* slot) {
  Float m0 = {}, mr = {}, my = {}, mrr = {}, mry = {}, myy = {};
  Float red = {}, green = {}, blue = {}, depth = {};
  const Splat& g = chunk.splats[k];
  for (int i = chunk.first[k]; i < chunk.first[k + 1]; ++i) {
    const int s = chunk.sub_blocks[i];
    const Float dy = tile.y[s] - g.mean_y, r = shear(g, tile.x[s] - g.mean_x, dy);
    const Float G = chunk.contributions[i].gradient, weight = chunk.contributions[i].weight;
    const Float* v = grad.channels[s];
    const Float Gr = G * r, Gy = G * dy;
    m0 += G, mr += Gr, my += Gy;
    mrr += Gr * r, mry += Gr * dy, myy += Gy * dy;
    red += weight * v[0], green += weight * v[1], blue += weight * v[2], depth += weight * v[3];
  }
  const Float sums[kBaseGradients] = {m0, mr, my, mrr, mry, myy, red, green, blue, depth};
  alignas(64) float line[kSlotStride];
  sum10(sums, line);
  write_slot(line, slot);
}

// Slots of the feature channels: sums of the contributions' weight times image gradient.
template <int kGroup>
inline void feature_group(const Chunk& chunk, int k, const float* pixel_features, int channels, float* slot) {
  Float a[kGroup] = {};
  for (int i = chunk.first[k]; i < chunk.first[k + 1]; ++i) {
    const Float weight = chunk.contributions[i].weight;
    const float* v = pixel_features + chunk.sub_blocks[i] * channels * kLanes;
    for (int q = 0; q < kGroup; ++q) a[q] += weight * load(v + q * kLanes);
  }
  for (int q = 0; q < kGroup; q += 4) sum4(a[q], a[q + 1], a[q + 2], a[q + 3], slot + q);
}

inline void sum_features(const Chunk& chunk, int k, const float* pixel_features, int channels, float* slot) {
  int q = 0;
  for (; q + kFeatureGroup <= channels; q += kFeatureGroup)
    feature_group<kFeatureGroup>(chunk, k, pixel_features + q * kLanes, channels, slot + q);
  for (; q + 8 <= channels; q += 8) feature_group<8>(chunk, k, pixel_features + q * kLanes, channels, slot + q);
  if (q < channels) feature_group<4>(chunk, k, pixel_features + q * kLanes, channels, slot + q);
}

// Asks for a share of the splats of the next chunk, which ends at entry `end`, while sub-block s is worked on. All at
// once they would wait for one another.
GGSLAM_PREFETCHING prefetch_share(const Rasterizer& r, const Tile& tile, std::int32_t end, int s) {
  constexpr int kShare = kChunk / kSubBlocks;
  const TileEntry* entries = r.entries.data() + tile.begin;
  for (int k = kShare * s; k < kShare * (s + 1); ++k)
    if (k < end) __builtin_prefetch(r.splats.data() + entries[end - 1 - k].splat);
}

// Entries [begin, begin + n) of the tile's list.
void load_chunk(const Rasterizer& r, int index, const Tile& tile, std::int32_t begin, int n, Chunk& chunk) {
  const int tile_x = index % r.tiles_x, tile_y = index / r.tiles_x;
  const TileEntry* entries = r.entries.data() + tile.begin;
  alignas(64) std::uint32_t masks[kChunk] = {};
  __builtin_memcpy(masks, r.contributed.data() + tile.begin + begin, sizeof(*masks) * n);
  transpose_masks(masks, chunk.contributing);
  std::int32_t next = 0;
  for (int k = 0; k < n; ++k) {
    chunk.contributed[k] = masks[k];
    chunk.first[k] = chunk.next[k] = next;
    chunk.numbers[k] = begin + k;
    next += __builtin_popcount(masks[k]);
    const std::uint32_t splat = entries[begin + k].splat;
    const Splat& g = chunk.splats[k] = r.splats[splat];
    chunk.pairs[k] = r.pair_number(splat, g, tile_x, tile_y);
  }
  chunk.first[n] = next;
}

// Replaces the gradients of contributions by the dot products of features and image gradients.
void write_feature_dots(const Rasterizer& r, int n, const ThreadScratch& scratch, Chunk& chunk) {
  Float dots[kSubBlocks];
  float* features = scratch.gaussian_features.data();
  for (int k = 0; k < n; ++k) {
    if (k + kRowPrefetch < n) prefetch_features(r.gaussians, chunk.splats[k + kRowPrefetch].gaussian);
    if (chunk.contributed[k] == 0) continue;
    copy_features(r.gaussians, chunk.splats[k].gaussian, r.padded_features, features);
    feature_dots(chunk.contributed[k], features, scratch.pixel_features.data(), r.padded_features, dots);
    Contribution* out = chunk.contributions + chunk.first[k];
    for (std::uint32_t left = chunk.contributed[k]; left != 0; left &= left - 1)
      (out++)->gradient = dots[__builtin_ctz(left)];
  }
}

template <FeatureMode kMode>
void differentiate_tile(Rasterizer& r, int index, const Tile& tile, TileGradients& grad, ThreadScratch& scratch) {
  Chunk chunk;
  Stage stage;
  chunk.contributions = reinterpret_cast<Contribution*>(scratch.contributions.data());
  const int channels = r.padded_features;
  std::int32_t end = grad.last_in_tile + 1;
  for (std::int32_t k = 0; k < kChunk && k < end; ++k)
    __builtin_prefetch(r.splats.data() + r.entries[tile.begin + end - 1 - k].splat);
  while (end > 0) {
    const std::int32_t begin = end > kChunk ? end - kChunk : 0;
    const int n = end - begin;
    end = begin;
    load_chunk(r, index, tile, begin, n, chunk);
    if (kMode == kFeaturesReachGeometry) write_feature_dots(r, n, scratch, chunk);
    for (int s = 0; s < kSubBlocks; ++s) {
      prefetch_share(r, tile, begin, s);
      if (chunk.contributing[s] != 0) differentiate_sub_block<kMode>(tile, s, chunk, grad, stage);
    }
    for (int k = 0; k < n; ++k) {
      if (chunk.contributed[k] == 0) continue;
      const std::size_t pair = chunk.pairs[k];
      sum_splat(tile, chunk, k, grad, r.slots.data() + pair * kSlotStride);
      if (kMode != kNoFeatures)
        sum_features(chunk, k, scratch.pixel_features.data(), channels, r.feature_slots.data() + pair * channels);
      r.slot_used[pair] = 1;
    }
  }
  finish_slots();
}

}  // namespace

void backward_tile(Rasterizer& r, int index, const ImageGradients& gradients, ThreadScratch& scratch) {
  const Tile tile = make_tile(r, index);
  if (tile.begin == tile.end) return;
  TileGradients grad;
  load_gradients(r, index, tile, gradients, scratch, grad);
  if (r.padded_features == 0) {
    differentiate_tile<kNoFeatures>(r, index, tile, grad, scratch);
  } else if (gradients.detach_features) {
    differentiate_tile<kFeaturesDetached>(r, index, tile, grad, scratch);
  } else {
    differentiate_tile<kFeaturesReachGeometry>(r, index, tile, grad, scratch);
  }
}

}  // namespace ggslam::GGSLAM_ISA
