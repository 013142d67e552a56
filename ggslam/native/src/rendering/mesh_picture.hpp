// SPDX-License-Identifier: Apache-2.0
// Pictures of triangle meshes: a rasteriser with a depth buffer.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/core/rendering.hpp"

// Column, row and inverse depth; the latter is 0 in front of the nearest plane.
struct ProjectedVertex {
  float u, v, inverse_z;
};
