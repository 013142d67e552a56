// SPDX-License-Identifier: Apache-2.0
// Visits the tiles of a rectangle with few branches. Most rectangles are 1x1, 1x2, 2x1 or 2x2 tiles, in random order;
// loops over them would be mispredicted about once per splat.
#pragma once
#include "rendering/rasterizer.hpp"

namespace ggslam::GGSLAM_ISA {

// Calls visit(tile, 1) for each tile of the rectangle, row by row, and visit(spare, 0) for places of the 2 x 2 pattern
// that the rectangle does not have. `spare` is the number of a tile that does not exist.
template <class Visit>
static inline void visit_tiles(TileRectangle rectangle, int tiles_x, int spare, const Visit& visit) {
  const int first = rectangle.y * tiles_x + rectangle.x;
  if (__builtin_expect(rectangle.wide <= 2 && rectangle.high <= 2, 1)) {
    const int wide = rectangle.wide - 1, high = rectangle.high - 1;
    visit(first, 1);
    visit(wide ? first + 1 : spare, wide);
    visit(high ? first + tiles_x : spare, high);
    visit(wide & high ? first + tiles_x + 1 : spare, wide & high);
    return;
  }
  for (int y = 0; y < rectangle.high; ++y)
    for (int x = 0; x < rectangle.wide; ++x) visit(first + y * tiles_x + x, 1);
}

}  // namespace ggslam::GGSLAM_ISA
