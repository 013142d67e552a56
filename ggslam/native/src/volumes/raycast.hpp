// SPDX-License-Identifier: Apache-2.0
// The surface of a TSDF as a camera sees it.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/core/volumes.hpp"
#include "volumes/surface_cells.hpp"

namespace ggslam::volumes {

// What the rays of a tile of pixels are cast into.
struct RaycastScene {
  const SurfaceBlock* blocks;
  const int32_t* table;
  uint32_t table_mask;
  float voxel;
};

// Pixels [left, right) x [top, bottom); the surface lies between two depths.
struct RaycastTile {
  int32_t left, top, right, bottom;
  float from, to;
};

}  // namespace ggslam::volumes
