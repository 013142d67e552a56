// SPDX-License-Identifier: Apache-2.0
// Written by scripts/tools/make_native_mirrors.py from rendering.hpp; changes are lost. Size of each structure and
// offsets of its fields, in the order of the header, so that a caller can check its mirrors of them.
#include <cstddef>
#include <cstdint>

#include "interface/cuda/rendering.hpp"

using ggslam::cuda::AdamStep;
using ggslam::cuda::PixelTerms;
using ggslam::cuda::Rendering;
using ggslam::cuda::Sizes;
using ggslam::cuda::TermsByGaussian;

namespace {
constexpr std::size_t kLayout[] = {
    sizeof(Rendering), offsetof(Rendering, gaussians), offsetof(Rendering, view), offsetof(Rendering, pose),
    offsetof(Rendering, targets), offsetof(Rendering, gaussian_workspace), offsetof(Rendering, pair_workspace),
    offsetof(Rendering, pixel_workspace), offsetof(Rendering, pair_capacity),
    offsetof(Rendering, gaussian_sorting_bytes), offsetof(Rendering, pair_sorting_bytes),
    offsetof(Rendering, overflowed), offsetof(Rendering, overflows), offsetof(Rendering, stream),
    offsetof(Rendering, device),
    sizeof(Sizes), offsetof(Sizes, gaussian_workspace), offsetof(Sizes, pair_workspace),
    offsetof(Sizes, pixel_workspace), offsetof(Sizes, gradient_rows),
    sizeof(AdamStep), offsetof(AdamStep, means), offsetof(AdamStep, quaternions), offsetof(AdamStep, log_scales),
    offsetof(AdamStep, opacity_logits), offsetof(AdamStep, sh), offsetof(AdamStep, features),
    offsetof(AdamStep, updates), offsetof(AdamStep, rates), offsetof(AdamStep, decayed_groups),
    offsetof(AdamStep, falling_groups), offsetof(AdamStep, log_decay), offsetof(AdamStep, decay_floor),
    offsetof(AdamStep, fall_rate), offsetof(AdamStep, fall_floor), offsetof(AdamStep, beta1), offsetof(AdamStep, beta2),
    offsetof(AdamStep, log_beta1), offsetof(AdamStep, log_beta2), offsetof(AdamStep, epsilon),
    sizeof(PixelTerms), offsetof(PixelTerms, pixels), offsetof(PixelTerms, gaussians), offsetof(PixelTerms, weights),
    offsetof(PixelTerms, counts), offsetof(PixelTerms, stream), offsetof(PixelTerms, capacity),
    offsetof(PixelTerms, device),
    sizeof(TermsByGaussian), offsetof(TermsByGaussian, gaussians), offsetof(TermsByGaussian, places),
    offsetof(TermsByGaussian, size), offsetof(TermsByGaussian, count),
};
}  // namespace

GGSLAM_EXPORT const std::size_t* ggslam_cuda_rendering_layout(int* count) {
  *count = static_cast<int>(sizeof(kLayout) / sizeof(kLayout[0]));
  return kLayout;
}
