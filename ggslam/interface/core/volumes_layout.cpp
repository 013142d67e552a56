// SPDX-License-Identifier: Apache-2.0
// Written by scripts/tools/make_native_mirrors.py from volumes.hpp; changes are lost. Size of each structure and
// offsets of its fields, in the order of the header, so that a caller can check its mirrors of them.
#include <cstddef>
#include <cstdint>

#include "interface/core/volumes.hpp"

using ggslam::DepthImage;
using ggslam::InsertResult;
using ggslam::InsertSettings;
using ggslam::OccupancyLeaf;
using ggslam::OccupancySummary;
using ggslam::volumes::FieldStats;
using ggslam::volumes::FusionInput;
using ggslam::volumes::FusionSettings;
using ggslam::volumes::FusionStats;
using ggslam::volumes::MeshArrays;
using ggslam::volumes::RaycastView;
using ggslam::volumes::SurfaceImages;
using ggslam::volumes::VoxelArrays;

namespace {
constexpr std::size_t kLayout[] = {
    sizeof(VoxelArrays), offsetof(VoxelArrays, value), offsetof(VoxelArrays, weight), offsetof(VoxelArrays, label),
    offsetof(VoxelArrays, color), offsetof(VoxelArrays, votes), offsetof(VoxelArrays, hits),
    offsetof(VoxelArrays, octants),
    sizeof(FusionSettings), offsetof(FusionSettings, min_depth), offsetof(FusionSettings, max_depth),
    offsetof(FusionSettings, free_share), offsetof(FusionSettings, edge), offsetof(FusionSettings, clearing),
    offsetof(FusionSettings, max_free_weight), offsetof(FusionSettings, points), offsetof(FusionSettings, bounded),
    offsetof(FusionSettings, low), offsetof(FusionSettings, high),
    sizeof(FusionInput), offsetof(FusionInput, depth), offsetof(FusionInput, color), offsetof(FusionInput, labels),
    offsetof(FusionInput, width), offsetof(FusionInput, height), offsetof(FusionInput, fx), offsetof(FusionInput, fy),
    offsetof(FusionInput, cx), offsetof(FusionInput, cy), offsetof(FusionInput, rotation),
    offsetof(FusionInput, translation),
    sizeof(FusionStats), offsetof(FusionStats, blocks), offsetof(FusionStats, updated), offsetof(FusionStats, made),
    offsetof(FusionStats, freed), offsetof(FusionStats, prepare_ms), offsetof(FusionStats, select_ms),
    offsetof(FusionStats, update_ms),
    sizeof(FieldStats), offsetof(FieldStats, changed_blocks), offsetof(FieldStats, changed_sites),
    offsetof(FieldStats, recomputed_blocks), offsetof(FieldStats, blocks), offsetof(FieldStats, transformed),
    offsetof(FieldStats, sites_ms), offsetof(FieldStats, select_ms), offsetof(FieldStats, transform_ms),
    sizeof(MeshArrays), offsetof(MeshArrays, vertices), offsetof(MeshArrays, normals), offsetof(MeshArrays, colors),
    offsetof(MeshArrays, labels), offsetof(MeshArrays, triangles),
    sizeof(RaycastView), offsetof(RaycastView, fx), offsetof(RaycastView, fy), offsetof(RaycastView, cx),
    offsetof(RaycastView, cy), offsetof(RaycastView, near), offsetof(RaycastView, far), offsetof(RaycastView, rotation),
    offsetof(RaycastView, position), offsetof(RaycastView, width), offsetof(RaycastView, height),
    sizeof(SurfaceImages), offsetof(SurfaceImages, depth), offsetof(SurfaceImages, normals),
    offsetof(SurfaceImages, colors), offsetof(SurfaceImages, labels),
    sizeof(InsertSettings), offsetof(InsertSettings, max_range), offsetof(InsertSettings, origin),
    offsetof(InsertSettings, hit), offsetof(InsertSettings, miss), offsetof(InsertSettings, minimum),
    offsetof(InsertSettings, maximum), offsetof(InsertSettings, quantize), offsetof(InsertSettings, last_voxel),
    sizeof(InsertResult), offsetof(InsertResult, rays), offsetof(InsertResult, free), offsetof(InsertResult, occupied),
    sizeof(DepthImage), offsetof(DepthImage, depth), offsetof(DepthImage, width), offsetof(DepthImage, height),
    offsetof(DepthImage, fx), offsetof(DepthImage, fy), offsetof(DepthImage, cx), offsetof(DepthImage, cy),
    offsetof(DepthImage, low), offsetof(DepthImage, high), offsetof(DepthImage, free),
    offsetof(DepthImage, T_world_camera),
    sizeof(OccupancyLeaf), offsetof(OccupancyLeaf, centre), offsetof(OccupancyLeaf, size),
    offsetof(OccupancyLeaf, log_odds),
    sizeof(OccupancySummary), offsetof(OccupancySummary, occupied), offsetof(OccupancySummary, free),
    offsetof(OccupancySummary, blocks), offsetof(OccupancySummary, nodes), offsetof(OccupancySummary, bytes),
    offsetof(OccupancySummary, known_low), offsetof(OccupancySummary, known_high),
    offsetof(OccupancySummary, occupied_low), offsetof(OccupancySummary, occupied_high),
};
}  // namespace

GGSLAM_EXPORT const std::size_t* ggslam_volumes_layout(int* count) {
  *count = static_cast<int>(sizeof(kLayout) / sizeof(kLayout[0]));
  return kLayout;
}
