// SPDX-License-Identifier: Apache-2.0
// Entry points of sampled compositing: pixels are handed out by tile, terms are sorted by Gaussian.
#include "rendering/pixel_terms.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "common/guard.hpp"

namespace ggslam {
namespace {

// Places the pixels in the order of tiles and, within a tile, of sub-blocks: lanes that lie together walk together.
struct SortedPixels {
  std::vector<TermPixel> pixels;
  std::vector<std::int32_t> tile_start;
};

SortedPixels sort_pixels(const Rasterizer& r, const std::int32_t* pixels, std::int64_t count) {
  const int sub_height = r.tile.lanes / 4, sub_columns = r.tile.width / 4;  // a sub-block is 4 pixels wide
  std::vector<TermPixel> found(count);
  std::vector<std::int32_t> key(count), start(static_cast<std::size_t>(r.tiles()) * kSubBlocks + 1, 0);
  for (std::int64_t i = 0; i < count; ++i) {
    const int x = pixels[i] % r.view.width, y = pixels[i] / r.view.width;
    const int in_x = x % r.tile.width, in_y = y % r.tile.height;
    const int sub = in_y / sub_height * sub_columns + in_x / 4;
    found[i] = {x, y, static_cast<std::int32_t>(i), sub, in_y % sub_height * 4 + in_x % 4};
    key[i] = (y / r.tile.height * r.tiles_x + x / r.tile.width) * kSubBlocks + sub;
    ++start[key[i] + 1];
  }
  for (std::size_t k = 1; k < start.size(); ++k) start[k] += start[k - 1];
  SortedPixels sorted{std::vector<TermPixel>(count), std::vector<std::int32_t>(r.tiles() + 1)};
  for (int tile = 0; tile <= r.tiles(); ++tile) sorted.tile_start[tile] = start[static_cast<std::size_t>(tile) * kSubBlocks];
  for (std::int64_t i = 0; i < count; ++i) sorted.pixels[start[key[i]]++] = found[i];
  return sorted;
}

// Room for the terms of each pixel, and no more of them.
const PixelTerms& check_terms(const PixelTerms* pointer) {
  const PixelTerms& terms = object_of<PixelTerms>(pointer);
  const std::int64_t most = static_cast<std::int64_t>(elements(terms.pixels, terms.capacity));
  if (terms.pixels > std::numeric_limits<std::int32_t>::max()) refuse("pixels: too many to number");
  check_array("gaussians", terms.gaussians, most), check_array("weights", terms.weights, most);
  check_array("counts", terms.counts, terms.pixels);
  return terms;
}

void check_counts(const PixelTerms& terms) {
  for (std::int64_t p = 0; p < terms.pixels; ++p) check_range("counts", terms.counts[p], 0, terms.capacity);
}

void check_gaussians(const PixelTerms& terms, std::int64_t gaussians) {
  check_counts(terms);
  for (std::int64_t p = 0; p < terms.pixels; ++p)
    for (int i = 0; i < terms.counts[p]; ++i)
      if (const std::int32_t g = terms.gaussians[p * terms.capacity + i]; g < 0 || g >= gaussians)
        refuse("terms: expected Gaussians below %lld, found %d", static_cast<long long>(gaussians), g);
}

// The transposed terms. Counting sort, so that the order within a Gaussian is that of the pixels.
class Transposed {
 public:
  Transposed(const PixelTerms& terms, std::int64_t gaussians) : first_(elements(gaussians) + 1, 0) {
    check_counts(terms);
    std::int64_t total = 0;
    for (std::int64_t p = 0; p < terms.pixels; ++p) {
      total += terms.counts[p];
      for (int i = 0; i < terms.counts[p]; ++i) {
        const std::int32_t g = terms.gaussians[p * terms.capacity + i];
        if (g < 0 || g >= gaussians) refuse("terms: expected Gaussians below %lld, found %d", static_cast<long long>(gaussians), g);
        ++first_[g];
      }
    }
    rows_.resize(total);
    weights_.resize(total);
    std::int64_t next = 0;
    for (std::int64_t g = 0; g < gaussians; ++g) {
      const std::int32_t here = first_[g];
      if (here == 0) continue;
      touched_.push_back(static_cast<std::int32_t>(g));
      starts_.push_back(next);
      first_[g] = static_cast<std::int32_t>(next);
      next += here;
    }
    starts_.push_back(next);
    for (std::int64_t p = 0; p < terms.pixels; ++p) {
      for (int i = 0; i < terms.counts[p]; ++i) {
        const std::int64_t from = p * terms.capacity + i;
        const std::int32_t to = first_[terms.gaussians[from]]++;
        rows_[to] = static_cast<std::int32_t>(p);
        weights_[to] = terms.weights[from];
      }
    }
  }
  std::int64_t size() const { return static_cast<std::int64_t>(touched_.size()); }
  TermsByGaussian view() const { return {touched_.data(), starts_.data(), rows_.data(), weights_.data()}; }

 private:
  std::vector<std::int32_t> first_, touched_, rows_;
  std::vector<std::int64_t> starts_;
  std::vector<float> weights_;
};

// Adds the weight of `label` to a Gaussian's slots. With every slot taken by other labels, the lightest one gives way
// and leaves its weight as the newcomer's head start (the space-saving sketch of Metwally et al. 2005), so that a label
// that holds more than 1 / slots of all the weight is never lost.
void add_vote(std::int32_t* ids, float* weights, int slots, std::int32_t label, float weight) {
  int lightest = 0;
  for (int s = 0; s < slots; ++s) {
    if (ids[s] == label) {
      weights[s] += weight;
      return;
    }
    if (weights[s] < weights[lightest]) lightest = s;
  }
  ids[lightest] = label;
  weights[lightest] += weight;
}

// Adds the votes of some touched Gaussians.
void add_votes(const TermsByGaussian& terms, const TermVotes& votes, std::size_t begin, std::size_t end) {
  for (std::size_t i = begin; i < end; ++i) {
    const std::size_t at = static_cast<std::size_t>(terms.touched[i]) * votes.slots;
    for (std::int64_t k = terms.starts[i]; k < terms.starts[i + 1]; ++k) {
      const std::int32_t row = terms.rows[k];
      const float factor = votes.pixel_weights != nullptr ? votes.pixel_weights[row] : 1.0f;
      if (votes.labels[row] != 0)
        add_vote(votes.ids + at, votes.weights + at, votes.slots, votes.labels[row], factor * terms.weights[k]);
    }
  }
}

const TermVotes& check_votes(const TermVotes* pointer, const PixelTerms& terms, std::int64_t gaussians) {
  const TermVotes& votes = object_of<TermVotes>(pointer);
  check_range("slots", votes.slots, 1, 1 << 16);
  check_array("labels", votes.labels, terms.pixels);
  check_array("ids", votes.ids, gaussians), check_array("weights", votes.weights, gaussians);
  return votes;
}

const FeatureAdam& check_adam(const FeatureAdam* pointer, const PixelTerms& terms, const float* gradient) {
  const FeatureAdam& adam = object_of<FeatureAdam>(pointer);
  check_range("channels", adam.channels, 0, kMaxTermChannels);
  check_range("schedule_rows", adam.schedule_rows, 1, std::numeric_limits<std::int32_t>::max());
  const void* const first = adam.short_moments != nullptr ? static_cast<const void*>(adam.short_moments) : adam.first_moments;
  const void* const arrays[] = {adam.features, first, adam.second_moments, adam.updates, adam.schedule};
  for (const void* array : arrays) check_array("features and moments", array, adam.gaussians);
  check_array("gradient", gradient, terms.pixels);
  return adam;
}

constexpr int kDistinct = 16;
constexpr int kMostChannels = 1 << 16;

// The label with the largest sum of weights among a pixel's terms, and its share of the whole.
void label_pixel(const PixelTerms& terms, std::int64_t p, const std::uint16_t* labels, std::uint16_t& id, float& share) {
  std::uint16_t ids[kDistinct];
  float sums[kDistinct], whole = 0;
  int distinct = 0;
  for (int i = 0; i < terms.counts[p]; ++i) {
    const std::int64_t at = p * terms.capacity + i;
    const std::uint16_t label = labels[terms.gaussians[at]];
    whole += terms.weights[at];
    int k = 0;
    while (k < distinct && ids[k] != label) ++k;
    if (k == kDistinct) continue;  // the seventeenth label of a pixel will not be the heaviest one
    if (k == distinct) ids[distinct] = label, sums[distinct++] = 0;
    sums[k] += terms.weights[at];
  }
  const int best = distinct == 0 ? 0 : static_cast<int>(std::max_element(sums, sums + distinct) - sums);
  id = distinct == 0 ? 0 : ids[best];
  share = distinct == 0 ? 0 : sums[best] / whole;
}

}  // namespace
}  // namespace ggslam

using namespace ggslam;

GGSLAM_EXPORT int ggslam_rasterizer_pixel_terms(void* rasterizer, const std::int32_t* pixels, float min_weight,
                                                const PixelTerms* out) try {
  const Rasterizer& r = object_of<Rasterizer>(rasterizer);
  const std::int64_t count = check_terms(out).pixels, size = std::int64_t{r.view.width} * r.view.height;
  check_array("pixels", pixels, count);
  if (!r.ready) refuse("rasterizer: there is no picture yet");
  for (std::int64_t i = 0; i < count; ++i)
    if (pixels[i] < 0 || pixels[i] >= size)
      refuse("pixels: expected those of the last picture, below %lld, found %d", static_cast<long long>(size), pixels[i]);
  const SortedPixels sorted = sort_pixels(r, pixels, out->pixels);
  const auto collect = GGSLAM_DISPATCH(r.context.isa, collect_terms);
  r.context.pool.parallel_for(r.tiles(), 1, [&](std::size_t tile, std::size_t, int) {
    const std::int32_t first = sorted.tile_start[tile], count = sorted.tile_start[tile + 1] - first;
    if (count > 0) collect(r, static_cast<int>(tile), sorted.pixels.data() + first, count, min_weight, *out);
  });
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_rasterizer_shown(void* rasterizer, float min_weight, std::int64_t gaussians,
                                          std::uint8_t* shown) try {
  const Rasterizer& r = object_of<Rasterizer>(rasterizer);
  if (!r.ready) refuse("rasterizer: there is no picture yet");
  if (gaussians != r.gaussians.count)
    refuse("gaussians: expected the %lld of the last picture, found %lld", static_cast<long long>(r.gaussians.count), static_cast<long long>(gaussians));
  check_array("shown", shown, gaussians);
  const auto mark = GGSLAM_DISPATCH(r.context.isa, mark_shown);
  r.context.pool.parallel_for(r.tiles(), 1, [&](std::size_t tile, std::size_t, int) {
    mark(r, static_cast<int>(tile), min_weight, shown);
  });
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_terms_blend(void* context, const PixelTerms* terms, const float* features,
                                     std::int64_t gaussians, int channels, float* out) try {
  Context& c = object_of<Context>(context);
  check_gaussians(check_terms(terms), gaussians);
  check_range("channels", channels, 0, kMostChannels);
  check_array("features", features, gaussians), check_array("out", out, terms->pixels);
  const auto blend = GGSLAM_DISPATCH(c.isa, blend_terms);
  c.pool.parallel_for(terms->pixels, 256, [&](std::size_t begin, std::size_t end, int) {
    blend(*terms, features, channels, static_cast<std::int64_t>(begin), static_cast<std::int64_t>(end), out);
  });
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_terms_step(void* context, const PixelTerms* terms, const float* gradient,
                                    const FeatureAdam* adam) try {
  Context& c = object_of<Context>(context);
  const Transposed transposed(check_terms(terms), object_of<FeatureAdam>(adam).gaussians);
  check_adam(adam, *terms, gradient);
  const TermsByGaussian view = transposed.view();
  const auto step = GGSLAM_DISPATCH(c.isa, step_term_rows);
  c.pool.parallel_for(transposed.size(), 512, [&](std::size_t begin, std::size_t end, int) {
    step(view, gradient, *adam, static_cast<std::int64_t>(begin), static_cast<std::int64_t>(end));
  });
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_terms_vote(void* context, const PixelTerms* terms, const std::uint16_t* labels,
                                    const float* pixel_weights, std::int64_t gaussians, int slots, std::int32_t* ids, float* weights) try {
  Context& c = object_of<Context>(context);
  const Transposed transposed(check_terms(terms), gaussians);
  const TermVotes votes{labels, pixel_weights, ids, weights, slots};
  check_votes(&votes, *terms, gaussians);
  const TermsByGaussian view = transposed.view();
  c.pool.parallel_for(transposed.size(), 512, [&](std::size_t begin, std::size_t end, int) {
    add_votes(view, votes, begin, end);
  });
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_terms_learn(void* context, const PixelTerms* terms, const float* gradient,
                                     const FeatureAdam* adam, const TermVotes* votes) try {
  Context& c = object_of<Context>(context);
  const Transposed transposed(check_terms(terms), object_of<FeatureAdam>(adam).gaussians);
  check_adam(adam, *terms, gradient);
  check_votes(votes, *terms, adam->gaussians);
  const TermsByGaussian view = transposed.view();
  const auto step = GGSLAM_DISPATCH(c.isa, step_term_rows);
  c.pool.parallel_for(transposed.size(), 512, [&](std::size_t begin, std::size_t end, int) {
    step(view, gradient, *adam, static_cast<std::int64_t>(begin), static_cast<std::int64_t>(end));
    add_votes(view, *votes, begin, end);
  });
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_terms_label(void* context, const PixelTerms* terms, const std::uint16_t* labels,
                                     std::int64_t gaussians, std::uint16_t* ids, float* shares) try {
  Context& c = object_of<Context>(context);
  check_gaussians(check_terms(terms), gaussians);
  check_array("labels", labels, gaussians), check_array("ids", ids, terms->pixels), check_array("shares", shares, terms->pixels);
  c.pool.parallel_for(terms->pixels, 1024, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t p = begin; p < end; ++p) label_pixel(*terms, static_cast<std::int64_t>(p), labels, ids[p], shares[p]);
  });
  return 0;
} GGSLAM_CATCH_ALL
