// SPDX-License-Identifier: Apache-2.0
// Written by scripts/tools/make_native_mirrors.py from rendering.hpp; changes are lost. Size of each structure and
// offsets of its fields, in the order of the header, so that a caller can check its mirrors of them.
#include <cstddef>
#include <cstdint>

#include "interface/core/rendering.hpp"

using ggslam::AdamArguments;
using ggslam::AdamArrays;
using ggslam::CameraView;
using ggslam::FeatureAdam;
using ggslam::GaussianArrays;
using ggslam::GaussianGradients;
using ggslam::ImageGradients;
using ggslam::MeshPictureInput;
using ggslam::PixelTerms;
using ggslam::RenderTargets;
using ggslam::TermVotes;

namespace {
constexpr std::size_t kLayout[] = {
    sizeof(GaussianArrays), offsetof(GaussianArrays, count), offsetof(GaussianArrays, means),
    offsetof(GaussianArrays, quaternions), offsetof(GaussianArrays, log_scales),
    offsetof(GaussianArrays, opacity_logits), offsetof(GaussianArrays, sh), offsetof(GaussianArrays, features),
    offsetof(GaussianArrays, sh_coefficients), offsetof(GaussianArrays, active_sh_coefficients),
    offsetof(GaussianArrays, feature_channels), offsetof(GaussianArrays, render_features),
    sizeof(CameraView), offsetof(CameraView, width), offsetof(CameraView, height), offsetof(CameraView, fx),
    offsetof(CameraView, fy), offsetof(CameraView, cx), offsetof(CameraView, cy), offsetof(CameraView, near_plane),
    offsetof(CameraView, low_pass), offsetof(CameraView, close_below), offsetof(CameraView, camera_world),
    sizeof(RenderTargets), offsetof(RenderTargets, image), offsetof(RenderTargets, features),
    offsetof(RenderTargets, depth), offsetof(RenderTargets, alpha), offsetof(RenderTargets, median_depth),
    sizeof(ImageGradients), offsetof(ImageGradients, image), offsetof(ImageGradients, features),
    offsetof(ImageGradients, depth), offsetof(ImageGradients, alpha), offsetof(ImageGradients, detach_features),
    sizeof(GaussianGradients), offsetof(GaussianGradients, means), offsetof(GaussianGradients, quaternions),
    offsetof(GaussianGradients, log_scales), offsetof(GaussianGradients, opacity_logits),
    offsetof(GaussianGradients, sh), offsetof(GaussianGradients, features), offsetof(GaussianGradients, twist),
    offsetof(GaussianGradients, touched),
    sizeof(AdamArrays), offsetof(AdamArrays, parameters), offsetof(AdamArrays, first_moments),
    offsetof(AdamArrays, second_moments),
    sizeof(AdamArguments), offsetof(AdamArguments, means), offsetof(AdamArguments, quaternions),
    offsetof(AdamArguments, log_scales), offsetof(AdamArguments, opacity_logits), offsetof(AdamArguments, sh),
    offsetof(AdamArguments, features), offsetof(AdamArguments, updates), offsetof(AdamArguments, schedule),
    offsetof(AdamArguments, schedule_rows), offsetof(AdamArguments, beta1), offsetof(AdamArguments, beta2),
    offsetof(AdamArguments, epsilon),
    sizeof(PixelTerms), offsetof(PixelTerms, pixels), offsetof(PixelTerms, capacity), offsetof(PixelTerms, gaussians),
    offsetof(PixelTerms, weights), offsetof(PixelTerms, counts),
    sizeof(FeatureAdam), offsetof(FeatureAdam, gaussians), offsetof(FeatureAdam, features),
    offsetof(FeatureAdam, first_moments), offsetof(FeatureAdam, second_moments), offsetof(FeatureAdam, updates),
    offsetof(FeatureAdam, schedule), offsetof(FeatureAdam, schedule_rows), offsetof(FeatureAdam, channels),
    offsetof(FeatureAdam, beta1), offsetof(FeatureAdam, beta2), offsetof(FeatureAdam, epsilon),
    offsetof(FeatureAdam, short_moments),
    sizeof(TermVotes), offsetof(TermVotes, labels), offsetof(TermVotes, pixel_weights), offsetof(TermVotes, ids),
    offsetof(TermVotes, weights), offsetof(TermVotes, slots),
    sizeof(MeshPictureInput), offsetof(MeshPictureInput, positions), offsetof(MeshPictureInput, colors),
    offsetof(MeshPictureInput, triangles), offsetof(MeshPictureInput, vertices), offsetof(MeshPictureInput, count),
    offsetof(MeshPictureInput, fx), offsetof(MeshPictureInput, fy), offsetof(MeshPictureInput, cx),
    offsetof(MeshPictureInput, cy), offsetof(MeshPictureInput, near), offsetof(MeshPictureInput, width),
    offsetof(MeshPictureInput, height), offsetof(MeshPictureInput, cull),
};
}  // namespace

GGSLAM_EXPORT const std::size_t* ggslam_rendering_layout(int* count) {
  *count = static_cast<int>(sizeof(kLayout) / sizeof(kLayout[0]));
  return kLayout;
}
