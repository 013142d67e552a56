// SPDX-License-Identifier: Apache-2.0
// Depth gathered along the rays of pixels rather than looked up at the projections of voxels.
#pragma once
#include "abi/core/volumes.hpp"
#include "volumes/tsdf_fusion.hpp"

namespace ggslam::volumes {

// Where a voxel near the surface has its depth from: kProjection: the image, at the voxel's projection; kRays: all rays
// that pass it; kHybrid: these, where they are `least_rays`, else the image.
constexpr int32_t kProjection = 0, kRays = 1, kHybrid = 2;

// Sums up, in scratch.rays, what the rays of all pixels with depth in range tell the voxels of the listed updates that
// they pass within the truncation of their depth (J. Amanatides and A. Woo, "A fast voxel traversal algorithm for ray
// tracing", 1987). Whole numbers are added, so the order does not matter.
void cast_rays(const Tsdf& map, const FusionInput& in, const FusionSettings& settings, Context& context,
               FusionScratch& scratch);

}  // namespace ggslam::volumes
