// SPDX-License-Identifier: Apache-2.0
// The inner loops of building a target (kernels/gicp_target.cpp), compiled once per instruction set.
#pragma once
#include "common/dispatch.hpp"
#include "tracking/tracking_types.hpp"

GGSLAM_DECLARE_KERNEL(void bin_gaussians(const TargetInput& input, const TargetSettings& settings, std::size_t begin,
                                         std::size_t end, uint64_t* keys, uint8_t* bits))
GGSLAM_DECLARE_KERNEL(void accumulate_members(const TargetInput& input, const TargetSettings& settings,
                                              const int32_t* members, const int32_t* voxels, std::size_t count,
                                              VoxelMoments* moments))
GGSLAM_DECLARE_KERNEL(void merge_moments(const VoxelMoments* parts, std::size_t count, VoxelMoments* sum))
GGSLAM_DECLARE_KERNEL(void finish_voxels(const TargetSettings& settings, const VoxelLevelView& level,
                                         const VoxelMoments* moments, std::size_t begin, std::size_t end, Voxel* out))
