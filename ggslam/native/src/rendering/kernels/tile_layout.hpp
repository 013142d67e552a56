// SPDX-License-Identifier: Apache-2.0
// The layout of a tile: kSubColumns x kSubRows sub-blocks of 4 x (kLanes / 4) pixels; one vector holds one sub-block,
// row by row. Larger tiles make fewer pairs of a splat and a tile, but shorter loops over a sub-block's splats.
#pragma once
#include "common/kernels/simd.hpp"
#include "rendering/rasterizer.hpp"

namespace ggslam::GGSLAM_ISA {

constexpr int kSubWidth = 4, kSubHeight = kLanes / 4;
constexpr int kSubColumns = kLanes == 16 ? 8 : 4, kSubRows = kSubBlocks / kSubColumns;
constexpr int kTileWidth = kSubColumns * kSubWidth, kTileHeight = kSubRows * kSubHeight;

}  // namespace ggslam::GGSLAM_ISA
