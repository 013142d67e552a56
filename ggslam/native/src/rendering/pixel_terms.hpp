// SPDX-License-Identifier: Apache-2.0
// Sampled compositing: which Gaussians make up a pixel, and with what weight. A rendered feature at a pixel is then the
// sum of weight times feature, so that feature channels can be rendered, trained and voted on at a few thousand pixels
// without compositing whole images of them.
//
//   collect_terms     walks the lists of the last rendering for some pixels                          pixel_terms.cpp
//   mark_shown        the same for all pixels of a tile, for who only asks which Gaussians show         pixel_terms.cpp
//   blend_terms       terms x features -> features at the pixels                                     term_features.cpp
//   step_term_rows    gradients at the pixels -> gradients of the Gaussians' features -> Adam        term_features.cpp
//
// pixel_terms_api.cpp runs them over tiles and blocks. Every sum has a fixed order.
#pragma once
#include "rendering/rasterizer.hpp"

namespace ggslam {

// Pixels sorted by tile and sub-block.
struct TermPixel {
  std::int32_t x, y, row;       // row in PixelTerms
  std::int32_t sub_block, lane;
};

// Terms sorted by Gaussian: those of Gaussian touched[i] are starts[i] to starts[i + 1].
struct TermsByGaussian {
  const std::int32_t* touched;
  const std::int64_t* starts;
  const std::int32_t* rows;
  const float* weights;
};

constexpr int kMaxTermChannels = 64;

}  // namespace ggslam

GGSLAM_DECLARE_KERNEL(void collect_terms(const Rasterizer& r, int tile, const TermPixel* pixels, int count,
                                         float min_weight, const PixelTerms& out))
GGSLAM_DECLARE_KERNEL(void mark_shown(const Rasterizer& r, int tile, float min_weight, std::uint8_t* shown))
GGSLAM_DECLARE_KERNEL(void blend_terms(const PixelTerms& terms, const float* features, int channels,
                                       std::int64_t begin, std::int64_t end, float* out))
GGSLAM_DECLARE_KERNEL(void step_term_rows(const TermsByGaussian& terms, const float* gradient, const FeatureAdam& adam,
                                          std::int64_t begin, std::int64_t end))
