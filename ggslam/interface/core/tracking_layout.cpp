// SPDX-License-Identifier: Apache-2.0
// Written by scripts/tools/make_native_mirrors.py from tracking.hpp; changes are lost. Size of each structure and
// offsets of its fields, in the order of the header, so that a caller can check its mirrors of them.
#include <cstddef>
#include <cstdint>

#include "interface/core/tracking.hpp"

using ggslam::AlignPoints;
using ggslam::AlignResult;
using ggslam::AlignSettings;
using ggslam::DepthPointsOutput;
using ggslam::DepthPointsSettings;
using ggslam::PhotometricPoints;
using ggslam::PhotometricReferenceView;
using ggslam::TargetInput;
using ggslam::TargetSettings;
using ggslam::Voxel;
using ggslam::VoxelMoments;

namespace {
constexpr std::size_t kLayout[] = {
    sizeof(DepthPointsSettings), offsetof(DepthPointsSettings, fx), offsetof(DepthPointsSettings, fy),
    offsetof(DepthPointsSettings, cx), offsetof(DepthPointsSettings, cy), offsetof(DepthPointsSettings, noise_constant),
    offsetof(DepthPointsSettings, noise_square), offsetof(DepthPointsSettings, min_depth),
    offsetof(DepthPointsSettings, max_depth), offsetof(DepthPointsSettings, min_thickness),
    offsetof(DepthPointsSettings, max_elongation), offsetof(DepthPointsSettings, min_neighbours),
    offsetof(DepthPointsSettings, max_weight), offsetof(DepthPointsSettings, width),
    offsetof(DepthPointsSettings, height), offsetof(DepthPointsSettings, stride), offsetof(DepthPointsSettings, window),
    offsetof(DepthPointsSettings, window_step),
    sizeof(DepthPointsOutput), offsetof(DepthPointsOutput, points), offsetof(DepthPointsOutput, normals),
    offsetof(DepthPointsOutput, covariances), offsetof(DepthPointsOutput, pixels), offsetof(DepthPointsOutput, weights),
    sizeof(TargetInput), offsetof(TargetInput, means), offsetof(TargetInput, quaternions),
    offsetof(TargetInput, log_scales), offsetof(TargetInput, opacity_logits), offsetof(TargetInput, birth),
    offsetof(TargetInput, camera_positions), offsetof(TargetInput, count), offsetof(TargetInput, cameras),
    sizeof(TargetSettings), offsetof(TargetSettings, voxel), offsetof(TargetSettings, min_opacity_logit),
    offsetof(TargetSettings, min_thickness), offsetof(TargetSettings, max_thickness),
    offsetof(TargetSettings, max_elongation), offsetof(TargetSettings, scatter_weight),
    offsetof(TargetSettings, neighbour_weight),
    sizeof(VoxelMoments), offsetof(VoxelMoments, weight), offsetof(VoxelMoments, offset), offsetof(VoxelMoments, outer),
    offsetof(VoxelMoments, own), offsetof(VoxelMoments, normal), offsetof(VoxelMoments, centre),
    sizeof(Voxel), offsetof(Voxel, mean), offsetof(Voxel, weight), offsetof(Voxel, normal), offsetof(Voxel, reserved),
    offsetof(Voxel, covariance), offsetof(Voxel, padding),
    sizeof(AlignSettings), offsetof(AlignSettings, translation_tolerance), offsetof(AlignSettings, rotation_tolerance),
    offsetof(AlignSettings, coarse_kernel_factor), offsetof(AlignSettings, noise_constant),
    offsetof(AlignSettings, noise_square), offsetof(AlignSettings, kernel_constant),
    offsetof(AlignSettings, kernel_sigmas), offsetof(AlignSettings, overlap_constant),
    offsetof(AlignSettings, overlap_sigmas), offsetof(AlignSettings, min_normal_dot),
    offsetof(AlignSettings, plane_variance), offsetof(AlignSettings, coarse_iterations),
    offsetof(AlignSettings, fine_iterations), offsetof(AlignSettings, coarse_points),
    offsetof(AlignSettings, min_matches), offsetof(AlignSettings, photometric_weight), offsetof(AlignSettings, huber),
    offsetof(AlignSettings, depth_tolerance),
    sizeof(AlignPoints), offsetof(AlignPoints, points), offsetof(AlignPoints, normals),
    offsetof(AlignPoints, covariances), offsetof(AlignPoints, weights), offsetof(AlignPoints, depths),
    offsetof(AlignPoints, count),
    sizeof(PhotometricPoints), offsetof(PhotometricPoints, points), offsetof(PhotometricPoints, intensity),
    offsetof(PhotometricPoints, count),
    sizeof(PhotometricReferenceView), offsetof(PhotometricReferenceView, pixels),
    offsetof(PhotometricReferenceView, fx), offsetof(PhotometricReferenceView, fy),
    offsetof(PhotometricReferenceView, cx), offsetof(PhotometricReferenceView, cy),
    offsetof(PhotometricReferenceView, width), offsetof(PhotometricReferenceView, height),
    offsetof(PhotometricReferenceView, rotation), offsetof(PhotometricReferenceView, translation),
    sizeof(AlignResult), offsetof(AlignResult, pose), offsetof(AlignResult, normal_matrix),
    offsetof(AlignResult, information), offsetof(AlignResult, cost), offsetof(AlignResult, overlap),
    offsetof(AlignResult, rmse), offsetof(AlignResult, photometric_residual), offsetof(AlignResult, photometric_share),
    offsetof(AlignResult, gain), offsetof(AlignResult, bias), offsetof(AlignResult, coarse_iterations),
    offsetof(AlignResult, fine_iterations), offsetof(AlignResult, matches), offsetof(AlignResult, inliers),
    offsetof(AlignResult, converged), offsetof(AlignResult, usable),
};
}  // namespace

GGSLAM_EXPORT const std::size_t* ggslam_tracking_layout(int* count) {
  *count = static_cast<int>(sizeof(kLayout) / sizeof(kLayout[0]));
  return kLayout;
}
