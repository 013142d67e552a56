// SPDX-License-Identifier: Apache-2.0
// Written by scripts/tools/make_native_mirrors.py from mapping.hpp; changes are lost. Size of each structure and
// offsets of its fields, in the order of the header, so that a caller can check its mirrors of them.
#include <cstddef>
#include <cstdint>

#include "interface/cuda/mapping.hpp"

using ggslam::cuda::AdamMoments;
using ggslam::cuda::ClassAdamJob;
using ggslam::cuda::CrossEntropyJob;
using ggslam::cuda::ImageLossJob;
using ggslam::cuda::InsertionJob;
using ggslam::cuda::KeyframeState;
using ggslam::cuda::KeyframeStepJob;
using ggslam::cuda::KeyframeWriteJob;
using ggslam::cuda::LossTotals;
using ggslam::cuda::NeighbourJob;
using ggslam::cuda::NeighbourLossJob;
using ggslam::cuda::PixelClassJob;
using ggslam::cuda::PixelPoolJob;

namespace {
constexpr std::size_t kLayout[] = {
    sizeof(ImageLossJob), offsetof(ImageLossJob, image), offsetof(ImageLossJob, depth), offsetof(ImageLossJob, alpha),
    offsetof(ImageLossJob, target_color), offsetof(ImageLossJob, target_depth), offsetof(ImageLossJob, target_valid),
    offsetof(ImageLossJob, exposure), offsetof(ImageLossJob, d_image), offsetof(ImageLossJob, d_depth),
    offsetof(ImageLossJob, d_alpha), offsetof(ImageLossJob, results), offsetof(ImageLossJob, workspace),
    offsetof(ImageLossJob, stream), offsetof(ImageLossJob, device), offsetof(ImageLossJob, height),
    offsetof(ImageLossJob, width), offsetof(ImageLossJob, target_depth_is_float),
    offsetof(ImageLossJob, normalised_depth), offsetof(ImageLossJob, charbonnier), offsetof(ImageLossJob, depth_scale),
    offsetof(ImageLossJob, dssim_weight), offsetof(ImageLossJob, depth_weight), offsetof(ImageLossJob, opacity_weight),
    offsetof(ImageLossJob, no_depth_weight), offsetof(ImageLossJob, minimum_alpha),
    offsetof(ImageLossJob, charbonnier_epsilon),
    sizeof(InsertionJob), offsetof(InsertionJob, color), offsetof(InsertionJob, depth), offsetof(InsertionJob, alpha),
    offsetof(InsertionJob, rendered_depth), offsetof(InsertionJob, total), offsetof(InsertionJob, means),
    offsetof(InsertionJob, quaternions), offsetof(InsertionJob, log_scales), offsetof(InsertionJob, rgb),
    offsetof(InsertionJob, pixels), offsetof(InsertionJob, workspace), offsetof(InsertionJob, stream),
    offsetof(InsertionJob, device), offsetof(InsertionJob, height), offsetof(InsertionJob, width),
    offsetof(InsertionJob, count), offsetof(InsertionJob, adaptive_stride), offsetof(InsertionJob, fill_stride),
    offsetof(InsertionJob, units_per_metre), offsetof(InsertionJob, fx), offsetof(InsertionJob, fy),
    offsetof(InsertionJob, cx), offsetof(InsertionJob, cy), offsetof(InsertionJob, rotation),
    offsetof(InsertionJob, translation), offsetof(InsertionJob, alpha_threshold),
    offsetof(InsertionJob, depth_tolerance_m), offsetof(InsertionJob, depth_tolerance_relative),
    offsetof(InsertionJob, scale_pixels), offsetof(InsertionJob, flatness), offsetof(InsertionJob, max_slope),
    offsetof(InsertionJob, texture_threshold), offsetof(InsertionJob, max_depth_m),
    sizeof(PixelPoolJob), offsetof(PixelPoolJob, mask), offsetof(PixelPoolJob, alias), offsetof(PixelPoolJob, counts),
    offsetof(PixelPoolJob, per_pixel), offsetof(PixelPoolJob, odds), offsetof(PixelPoolJob, sums),
    offsetof(PixelPoolJob, random), offsetof(PixelPoolJob, pixels), offsetof(PixelPoolJob, vote_weights),
    offsetof(PixelPoolJob, stream), offsetof(PixelPoolJob, balance), offsetof(PixelPoolJob, boundary),
    offsetof(PixelPoolJob, device), offsetof(PixelPoolJob, height), offsetof(PixelPoolJob, width),
    offsetof(PixelPoolJob, drawn),
    sizeof(NeighbourJob), offsetof(NeighbourJob, points), offsetof(NeighbourJob, rows),
    offsetof(NeighbourJob, neighbours), offsetof(NeighbourJob, workspace), offsetof(NeighbourJob, stream),
    offsetof(NeighbourJob, device), offsetof(NeighbourJob, point_count), offsetof(NeighbourJob, row_count),
    offsetof(NeighbourJob, k),
    sizeof(PixelClassJob), offsetof(PixelClassJob, mask), offsetof(PixelClassJob, pixels),
    offsetof(PixelClassJob, alias), offsetof(PixelClassJob, class_of), offsetof(PixelClassJob, labels),
    offsetof(PixelClassJob, classes), offsetof(PixelClassJob, known), offsetof(PixelClassJob, stream),
    offsetof(PixelClassJob, device), offsetof(PixelClassJob, count),
    sizeof(CrossEntropyJob), offsetof(CrossEntropyJob, logits), offsetof(CrossEntropyJob, targets),
    offsetof(CrossEntropyJob, known), offsetof(CrossEntropyJob, losses), offsetof(CrossEntropyJob, stream),
    offsetof(CrossEntropyJob, weight), offsetof(CrossEntropyJob, device), offsetof(CrossEntropyJob, count),
    offsetof(CrossEntropyJob, classes),
    sizeof(NeighbourLossJob), offsetof(NeighbourLossJob, logits), offsetof(NeighbourLossJob, gradients),
    offsetof(NeighbourLossJob, stream), offsetof(NeighbourLossJob, weight), offsetof(NeighbourLossJob, device),
    offsetof(NeighbourLossJob, samples), offsetof(NeighbourLossJob, neighbours), offsetof(NeighbourLossJob, classes),
    sizeof(ClassAdamJob), offsetof(ClassAdamJob, rows), offsetof(ClassAdamJob, first_moments),
    offsetof(ClassAdamJob, second_moments), offsetof(ClassAdamJob, gradients), offsetof(ClassAdamJob, known),
    offsetof(ClassAdamJob, steps), offsetof(ClassAdamJob, stream), offsetof(ClassAdamJob, rate),
    offsetof(ClassAdamJob, device), offsetof(ClassAdamJob, size),
    sizeof(AdamMoments), offsetof(AdamMoments, first), offsetof(AdamMoments, second),
    sizeof(KeyframeState), offsetof(KeyframeState, pose), offsetof(KeyframeState, exposure),
    offsetof(KeyframeState, pose_moments), offsetof(KeyframeState, exposure_moments),
    offsetof(KeyframeState, pose_steps), offsetof(KeyframeState, exposure_steps), offsetof(KeyframeState, pose_copy),
    offsetof(KeyframeState, exposure_copy),
    sizeof(LossTotals), offsetof(LossTotals, total), offsetof(LossTotals, color), offsetof(LossTotals, ssim),
    offsetof(LossTotals, depth), offsetof(LossTotals, last_psnr), offsetof(LossTotals, iterations),
    sizeof(KeyframeStepJob), offsetof(KeyframeStepJob, state), offsetof(KeyframeStepJob, twist),
    offsetof(KeyframeStepJob, results), offsetof(KeyframeStepJob, skipped), offsetof(KeyframeStepJob, totals),
    offsetof(KeyframeStepJob, stream), offsetof(KeyframeStepJob, pose_rate), offsetof(KeyframeStepJob, exposure_rate),
    offsetof(KeyframeStepJob, exposure_regularization), offsetof(KeyframeStepJob, step_exposure),
    offsetof(KeyframeStepJob, device),
    sizeof(KeyframeWriteJob), offsetof(KeyframeWriteJob, state), offsetof(KeyframeWriteJob, stream),
    offsetof(KeyframeWriteJob, pose), offsetof(KeyframeWriteJob, exposure), offsetof(KeyframeWriteJob, is_new),
    offsetof(KeyframeWriteJob, device),
};
}  // namespace

GGSLAM_EXPORT const std::size_t* ggslam_cuda_mapping_layout(int* count) {
  *count = static_cast<int>(sizeof(kLayout) / sizeof(kLayout[0]));
  return kLayout;
}
