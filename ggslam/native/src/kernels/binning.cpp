// SPDX-License-Identifier: Apache-2.0
// Writes each splat into the lists of the tiles it covers. Lists start in the order of the Gaussians; forward_tile
// sorts them by depth.
#include "rasterizer.hpp"

namespace ggslam::GGSLAM_ISA {

void scatter_block(Rasterizer& r, int block) {
  std::uint32_t* cursor = r.tile_cursor.data() + static_cast<std::size_t>(block) * r.tiles();
  TileEntry* entries = r.entries.data();
  const std::uint32_t first = static_cast<std::uint32_t>(r.block_begin(block));
  std::uint32_t pair = static_cast<std::uint32_t>(r.pairs[block]);
  for (std::int32_t i = 0; i < r.visible[block]; ++i) {
    Splat& splat = r.splats[first + i];
    splat.first_pair = pair;
    pair += static_cast<std::uint32_t>(splat.tiles_wide) * splat.tiles_high;
    TileEntry entry;
    __builtin_memcpy(&entry.depth_bits, &splat.depth, sizeof(float));
    entry.splat = first + i;
    for (int y = 0; y < splat.tiles_high; ++y) {
      std::uint32_t* row = cursor + (splat.tile_y + y) * r.tiles_x + splat.tile_x;
      for (int x = 0; x < splat.tiles_wide; ++x) entries[row[x]++] = entry;
    }
  }
}

}  // namespace ggslam::GGSLAM_ISA
