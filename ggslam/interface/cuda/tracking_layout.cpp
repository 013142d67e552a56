// SPDX-License-Identifier: Apache-2.0
// Written by scripts/tools/make_native_mirrors.py from tracking.hpp; changes are lost. Size of each structure and
// offsets of its fields, in the order of the header, so that a caller can check its mirrors of them.
#include <cstddef>
#include <cstdint>

#include "interface/cuda/tracking.hpp"

using ggslam::cuda::AlignJob;
using ggslam::cuda::DepthPointsJob;
using ggslam::cuda::PointArrays;
using ggslam::cuda::PointsHeader;
using ggslam::cuda::VoxelBlock;
using ggslam::cuda::VoxelLevel;
using ggslam::cuda::VoxelLevelJob;
using ggslam::cuda::VoxelSlot;

namespace {
constexpr std::size_t kLayout[] = {
    sizeof(PointsHeader), offsetof(PointsHeader, count), offsetof(PointsHeader, median_depth),
    sizeof(PointArrays), offsetof(PointArrays, header), offsetof(PointArrays, points), offsetof(PointArrays, normals),
    offsetof(PointArrays, covariances), offsetof(PointArrays, pixels), offsetof(PointArrays, weights),
    sizeof(DepthPointsJob), offsetof(DepthPointsJob, depth), offsetof(DepthPointsJob, out),
    offsetof(DepthPointsJob, workspace), offsetof(DepthPointsJob, stream), offsetof(DepthPointsJob, settings),
    offsetof(DepthPointsJob, device), offsetof(DepthPointsJob, columns), offsetof(DepthPointsJob, rows),
    sizeof(VoxelBlock), offsetof(VoxelBlock, key), offsetof(VoxelBlock, occupied), offsetof(VoxelBlock, first),
    sizeof(VoxelSlot), offsetof(VoxelSlot, key), offsetof(VoxelSlot, occupied), offsetof(VoxelSlot, first),
    offsetof(VoxelSlot, reserved),
    sizeof(VoxelLevel), offsetof(VoxelLevel, voxels), offsetof(VoxelLevel, slots), offsetof(VoxelLevel, slot_mask),
    offsetof(VoxelLevel, size), offsetof(VoxelLevel, inverse_size),
    sizeof(VoxelLevelJob), offsetof(VoxelLevelJob, blocks), offsetof(VoxelLevelJob, moments),
    offsetof(VoxelLevelJob, level), offsetof(VoxelLevelJob, voxels), offsetof(VoxelLevelJob, stream),
    offsetof(VoxelLevelJob, settings), offsetof(VoxelLevelJob, device), offsetof(VoxelLevelJob, block_count),
    offsetof(VoxelLevelJob, voxel_count),
    sizeof(AlignJob), offsetof(AlignJob, points), offsetof(AlignJob, fine), offsetof(AlignJob, coarse),
    offsetof(AlignJob, photometric_points), offsetof(AlignJob, reference), offsetof(AlignJob, match),
    offsetof(AlignJob, squared_distance), offsetof(AlignJob, results), offsetof(AlignJob, workspace),
    offsetof(AlignJob, stream), offsetof(AlignJob, guess), offsetof(AlignJob, settings), offsetof(AlignJob, device),
    offsetof(AlignJob, room),
};
}  // namespace

GGSLAM_EXPORT const std::size_t* ggslam_cuda_tracking_layout(int* count) {
  *count = static_cast<int>(sizeof(kLayout) / sizeof(kLayout[0]));
  return kLayout;
}
