// SPDX-License-Identifier: Apache-2.0
// The surface of a TSDF as a camera sees it.
#pragma once
#include <cstddef>
#include <cstdint>

#include "volumes/surface_cells.hpp"

namespace ggslam::volumes {

struct RaycastView {
  float fx, fy, cx, cy;
  float near, far;       // depth, metres
  float rotation[9];     // world from camera
  float position[3];     // of the camera, metres
  int32_t width, height;
};

// [height, width]: depth along the optical axis in metres, 0 where no surface is seen; unit normals [.., 3] in the
// camera's axes; colours [.., 3]; labels.
struct SurfaceImages {
  float* depth;
  float* normals;
  uint8_t* colors;
  uint16_t* labels;
};

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
