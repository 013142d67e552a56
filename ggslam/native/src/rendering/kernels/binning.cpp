// SPDX-License-Identifier: Apache-2.0
// Writes each splat into the lists of the tiles it covers. Lists start in the order of the Gaussians; forward_tile
// sorts them by depth.
#include "rendering/kernels/tile_rectangle.hpp"

namespace ggslam::GGSLAM_ISA {

void scatter_block(Rasterizer& r, int block) {
  std::uint32_t* cursors = r.cursors(block);
  const int tiles_x = r.tiles_x, spare = r.tiles();
  cursors[spare] = static_cast<std::uint32_t>(r.pair_count) + static_cast<std::uint32_t>(block);
  TileEntry* entries = r.entries.data();
  const std::uint32_t first = static_cast<std::uint32_t>(r.block_begin(block));
  for (std::int32_t i = 0; i < r.visible[block]; ++i) {
    const Footprint& footprint = r.footprints[first + i];
    const TileEntry entry{footprint.depth_bits, first + i};
    visit_tiles(footprint.tiles, tiles_x, spare, [=](int tile, int exists) {
      const std::uint32_t place = cursors[tile];
      cursors[tile] = place + exists;
      entries[place] = entry;
      __builtin_prefetch(entries + place + 8, 1);  // hundreds of lists are written at once
    });
  }
}

}  // namespace ggslam::GGSLAM_ISA
