// SPDX-License-Identifier: Apache-2.0
// Pictures of triangle meshes: a rasteriser with a depth buffer.
#pragma once
#include <cstddef>
#include <cstdint>

// Positions [vertices, 3] in the camera's axes, colours [vertices, 3] as they are to be seen; triangles
// [triangles, 3], counter-clockwise seen from their front.
struct MeshPictureInput {
  const float* positions;
  const uint8_t* colors;
  const int32_t* triangles;
  int64_t vertices, count;
  float fx, fy, cx, cy, near;
  int32_t width, height;
  int32_t cull;  // triangles seen from behind are left out
};

// Column, row and inverse depth; the latter is 0 in front of the nearest plane.
struct ProjectedVertex {
  float u, v, inverse_z;
};
