// SPDX-License-Identifier: Apache-2.0
// Backward of compositing one tile, back to front, splat by splat. With g = sum over channels of channel value times
// image gradient at a pixel, t the transmittance before the splat and "behind" the sum of weight * g over all splats
// behind it (starting from minus the final transmittance times the gradient of the alpha image):
//     d loss / d alpha = t g - behind / (1 - alpha)
// so one scalar per pixel stands for everything behind. The transmittance is recovered by dividing by 1 - alpha.
//
// d loss / d log(alpha) =: G leads to the splat's geometry through its moments sum G (1, r, dy, r^2, r dy, dy^2), r as
// in the splat. The sums over the tile's pixels go to the pair's own slot; gather.cpp adds up a Gaussian's slots.
#include "rendering/kernels/tile.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

enum FeatureMode { kNoFeatures, kFeaturesReachGeometry, kFeaturesDetached };

struct TileGradients {
  Float channels[kSubBlocks][4];                   // image gradients: red, green, blue, depth
  Float transmittance[kSubBlocks], behind[kSubBlocks];
  Int last[kSubBlocks];
  std::int32_t last_in_tile;                       // highest entry that contributed anywhere
};

// What one splat wrote to its sub-blocks, for the pass over the feature channels.
struct WeightList {
  Float weights[kSubBlocks];
  std::int32_t sub_blocks[kSubBlocks];
  int size;
};

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
    out.transmittance[s] = load(r.transmittance.data() + first + s * kLanes);
    out.last[s] = load_int(r.last_entry.data() + first + s * kLanes);
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

template <FeatureMode kMode>
inline void differentiate_splat(const Tile& tile, const Splat& g, int entry, std::uint32_t sub_blocks,
                                const Float* dots, TileGradients& grad, WeightList& list, float* slot) {
  Float m0 = {}, mr = {}, my = {}, mrr = {}, mry = {}, myy = {};
  Float red = {}, green = {}, blue = {}, depth = {};
  int size = 0;
  for (; sub_blocks != 0; sub_blocks &= sub_blocks - 1) {
    const int s = __builtin_ctz(sub_blocks);
    const Float dy = tile.y[s] - g.mean_y, r = shear(g, tile.x[s] - g.mean_x, dy);
    const Float exponent = log2_alpha(g, r, dy);
    const Mask taken = both(greater_equal(exponent, broadcast(kLog2MinAlpha)),
                            greater_equal_int(grad.last[s], broadcast_int(entry)));
    const Float unlimited = zero_unless(taken, exp2_unchecked(exponent));
    const Float alpha = minimum(unlimited, broadcast(kMaxAlpha));
    // alpha = 0 where the splat was not taken: the reciprocal is exactly 1 and all terms below vanish.
    const Float inverse = reciprocal(1.0f - alpha);
    const Float t = grad.transmittance[s] * inverse;
    grad.transmittance[s] = t;
    const Float weight = alpha * t;
    const Float* v = grad.channels[s];
    Float dot = g.red * v[0] + g.green * v[1] + g.blue * v[2] + g.depth * v[3];
    if (kMode == kFeaturesReachGeometry) dot += dots[s];
    const Float behind = grad.behind[s];
    const Float alpha_gradient = t * dot - inverse * behind;
    grad.behind[s] = behind + weight * dot;
    // At the limit kMaxAlpha, alpha does not depend on the splat's shape.
    const Float G = zero_unless(greater_equal(broadcast(kMaxAlpha), unlimited), alpha * alpha_gradient);
    const Float Gr = G * r, Gy = G * dy;
    m0 += G, mr += Gr, my += Gy;
    mrr += Gr * r, mry += Gr * dy, myy += Gy * dy;
    red += weight * v[0], green += weight * v[1], blue += weight * v[2], depth += weight * v[3];
    if (kMode != kNoFeatures) {
      list.weights[size] = weight;
      list.sub_blocks[size++] = s;
    }
  }
  list.size = size;
  sum4(m0, mr, my, mrr, slot);
  sum4(mry, myy, red, green, slot + 4);
  sum4(blue, depth, blue, depth, slot + 8);
}

template <int kGroup>
inline void feature_group(const WeightList& list, const float* pixel_features, int channels, float* slot) {
  Float a[kGroup] = {};
  for (int i = 0; i < list.size; ++i) {
    const Float weight = list.weights[i];
    const float* v = pixel_features + list.sub_blocks[i] * channels * kLanes;
    for (int q = 0; q < kGroup; ++q) a[q] += weight * load(v + q * kLanes);
  }
  for (int q = 0; q < kGroup; q += 4) sum4(a[q], a[q + 1], a[q + 2], a[q + 3], slot + q);
}

inline void differentiate_features(const WeightList& list, const float* pixel_features, int channels, float* slot) {
  int q = 0;
  for (; q + kFeatureGroup <= channels; q += kFeatureGroup)
    feature_group<kFeatureGroup>(list, pixel_features + q * kLanes, channels, slot + q);
  for (; q + 8 <= channels; q += 8) feature_group<8>(list, pixel_features + q * kLanes, channels, slot + q);
  if (q < channels) feature_group<4>(list, pixel_features + q * kLanes, channels, slot + q);
}

// Features are read and slots written in random order: their cache lines are asked for early.
GGSLAM_PREFETCHING prefetch_pair(const Rasterizer& r, std::uint32_t splat, int tile_x, int tile_y) {
  const Splat& g = r.splats[splat];
  const std::size_t pair = r.pair_number(splat, g, tile_x, tile_y);
  __builtin_prefetch(r.slots.data() + pair * kSlotStride, 1);
  for (int q = 0; q < r.padded_features; q += 16)
    __builtin_prefetch(r.feature_slots.data() + pair * r.padded_features + q, 1);
  if (r.padded_features > 0) prefetch_features(r.gaussians, g.gaussian);
}

template <FeatureMode kMode>
void differentiate_tile(Rasterizer& r, int index, const Tile& tile, TileGradients& grad, ThreadScratch& scratch) {
  const int tile_x = index % r.tiles_x, tile_y = index / r.tiles_x, channels = r.padded_features;
  const TileEntry* entries = r.entries.data() + tile.begin;
  const std::uint16_t* contributed = r.contributed.data() + tile.begin;
  float* features = scratch.gaussian_features.data();
  const float* pixel_features = scratch.pixel_features.data();
  WeightList list;
  Float dots[kSubBlocks];
  for (std::int32_t k = grad.last_in_tile; k >= 0; --k) {
    if (k >= kSplatPrefetch) __builtin_prefetch(r.splats.data() + entries[k - kSplatPrefetch].splat);
    if (k >= kRowPrefetch && contributed[k - kRowPrefetch] != 0)
      prefetch_pair(r, entries[k - kRowPrefetch].splat, tile_x, tile_y);
    if (contributed[k] == 0) continue;
    const Splat& g = r.splats[entries[k].splat];
    const std::size_t pair = r.pair_number(entries[k].splat, g, tile_x, tile_y);
    if (kMode == kFeaturesReachGeometry) {
      copy_features(r.gaussians, g.gaussian, channels, features);
      feature_dots(contributed[k], features, pixel_features, channels, dots);
    }
    differentiate_splat<kMode>(tile, g, k, contributed[k], dots, grad, list, r.slots.data() + pair * kSlotStride);
    if (kMode != kNoFeatures)
      differentiate_features(list, pixel_features, channels, r.feature_slots.data() + pair * channels);
    r.slot_used[pair] = 1;
  }
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
