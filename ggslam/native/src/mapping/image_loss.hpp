// SPDX-License-Identifier: Apache-2.0
// What the image loss works on: one rendered view against the stored images of one keyframe.
#pragma once
#include <cstddef>
#include <cstdint>

#include "common/dispatch.hpp"
#include "abi/core/mapping.hpp"

namespace ggslam {

constexpr int kImageLossTaps = 11;  // window of SSIM
constexpr int kImageLossRows = 4;   // rows that are blurred vertically together
constexpr int kImageLossSlots = kImageLossTaps - 1 + kImageLossRows;
constexpr int kImageLossPad = 16;   // floats of zeros on each side of a row that is blurred horizontally

// Row length used inside, a multiple of every vector length. Columns from W on hold zeros.
inline std::size_t image_loss_stride(int width) { return (static_cast<std::size_t>(width) + 15) / 16 * 16; }

// The target as floats, rows of `stride`: colour in [0, 1], depth in metres (0 = none), and the weight of the pixel's
// colour (1 with depth, no_depth_weight without, 0 beyond the image).
struct ImageLossPlanes {
  float* color[3];
  float* depth;
  float* weight;
  float* columns;  // one row: 1 within the image, 0 beyond
  std::size_t stride;
};

// Floats one thread needs for its rows: 4 of the depth image, 7 padded ones, 7 rings with their results, 2 of colour.
inline std::size_t image_loss_row_floats(std::size_t stride) {
  return 4 * stride + 7 * (stride + 2 * kImageLossPad) + 7 * (kImageLossSlots + kImageLossRows) * stride + 2 * stride;
}

// Sums over one band of rows of one channel (or of the depth image). They are added up in the order of the bands, so
// the result does not depend on which thread did which band.
struct ImageLossSums {
  double absolute, robust, squared, gain, offset, ssim;  // colour
  double depth, depth_pixels, transparency;              // depth and opacity
};

}  // namespace ggslam

// Fills rows [begin, end) of the planes; returns the number of pixels with depth.
GGSLAM_DECLARE_KERNEL(long long image_loss_prepare(const ImageLossJob& job, const ImageLossPlanes& planes, int begin,
                                                   int end))
// Colour terms of one channel, rows [begin, end) of d_image[channel]. `rows`: image_loss_row_floats(stride) zeros at
// first, 64-byte aligned; they may be reused for the next band of an image of the same width.
GGSLAM_DECLARE_KERNEL(void image_loss_color_band(const ImageLossJob& job, const ImageLossPlanes& planes, float* rows,
                                                 int channel, int begin, int end, ImageLossSums& sums))
// Depth and opacity terms, rows [begin, end) of d_depth and d_alpha.
GGSLAM_DECLARE_KERNEL(void image_loss_depth_band(const ImageLossJob& job, const ImageLossPlanes& planes, float* rows,
                                                 int begin, int end, ImageLossSums& sums))
