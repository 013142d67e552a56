// SPDX-License-Identifier: Apache-2.0
// Written by scripts/tools/make_native_mirrors.py from mapping.hpp; changes are lost. Size of each structure and
// offsets of its fields, in the order of the header, so that a caller can check its mirrors of them.
#include <cstddef>
#include <cstdint>

#include "interface/core/mapping.hpp"

using ggslam::CrossEntropyOfPixels;
using ggslam::ImageLossJob;
using ggslam::InsertionJob;

namespace {
constexpr std::size_t kLayout[] = {
    sizeof(ImageLossJob), offsetof(ImageLossJob, image), offsetof(ImageLossJob, depth), offsetof(ImageLossJob, alpha),
    offsetof(ImageLossJob, target_color), offsetof(ImageLossJob, target_depth), offsetof(ImageLossJob, target_valid),
    offsetof(ImageLossJob, d_image), offsetof(ImageLossJob, d_depth), offsetof(ImageLossJob, d_alpha),
    offsetof(ImageLossJob, height), offsetof(ImageLossJob, width), offsetof(ImageLossJob, target_row),
    offsetof(ImageLossJob, target_step), offsetof(ImageLossJob, target_depth_is_float),
    offsetof(ImageLossJob, normalised_depth), offsetof(ImageLossJob, charbonnier), offsetof(ImageLossJob, depth_scale),
    offsetof(ImageLossJob, exposure), offsetof(ImageLossJob, dssim_weight), offsetof(ImageLossJob, depth_weight),
    offsetof(ImageLossJob, opacity_weight), offsetof(ImageLossJob, no_depth_weight),
    offsetof(ImageLossJob, minimum_alpha), offsetof(ImageLossJob, charbonnier_epsilon), offsetof(ImageLossJob, total),
    offsetof(ImageLossJob, color), offsetof(ImageLossJob, l1), offsetof(ImageLossJob, ssim),
    offsetof(ImageLossJob, depth_term), offsetof(ImageLossJob, opacity_term), offsetof(ImageLossJob, depth_l1_m),
    offsetof(ImageLossJob, psnr), offsetof(ImageLossJob, valid_pixels), offsetof(ImageLossJob, exposure_gradient),
    sizeof(InsertionJob), offsetof(InsertionJob, color), offsetof(InsertionJob, depth), offsetof(InsertionJob, where),
    offsetof(InsertionJob, marks), offsetof(InsertionJob, pixels), offsetof(InsertionJob, means),
    offsetof(InsertionJob, quaternions), offsetof(InsertionJob, log_scales), offsetof(InsertionJob, rgb),
    offsetof(InsertionJob, height), offsetof(InsertionJob, width), offsetof(InsertionJob, adaptive_stride),
    offsetof(InsertionJob, fx), offsetof(InsertionJob, fy), offsetof(InsertionJob, cx), offsetof(InsertionJob, cy),
    offsetof(InsertionJob, rotation), offsetof(InsertionJob, translation), offsetof(InsertionJob, texture_threshold),
    offsetof(InsertionJob, max_depth), offsetof(InsertionJob, scale_pixels), offsetof(InsertionJob, flatness),
    offsetof(InsertionJob, max_slope),
    sizeof(CrossEntropyOfPixels), offsetof(CrossEntropyOfPixels, features), offsetof(CrossEntropyOfPixels, classes),
    offsetof(CrossEntropyOfPixels, weight), offsetof(CrossEntropyOfPixels, bias),
    offsetof(CrossEntropyOfPixels, d_features), offsetof(CrossEntropyOfPixels, d_rows),
    offsetof(CrossEntropyOfPixels, pixels), offsetof(CrossEntropyOfPixels, channels),
    offsetof(CrossEntropyOfPixels, count), offsetof(CrossEntropyOfPixels, nothing_logit),
    offsetof(CrossEntropyOfPixels, loss),
};
}  // namespace

GGSLAM_EXPORT const std::size_t* ggslam_mapping_layout(int* count) {
  *count = static_cast<int>(sizeof(kLayout) / sizeof(kLayout[0]));
  return kLayout;
}
