// SPDX-License-Identifier: Apache-2.0
// Finds the blocks that are about to be updated by their place.
#pragma once
#include "volumes/tsdf_scratch.hpp"

namespace ggslam::volumes {

// The numbers of blocks among a view's updates; as long as one block follows another of a few, the table is not asked.
class ListedBlocks {
 public:
  // `corner`: block from which places are counted. The updates' rows are listed in scratch.update_of_row.
  ListedBlocks(const Tsdf& map, const FusionScratch& scratch, const Vec3i& corner)
      : map_(map), scratch_(scratch), corner_(corner) {}

  // -1: the block is not listed. `x`, `y`, `z`: blocks from the corner.
  int32_t find(int32_t x, int32_t y, int32_t z) {
    Place& place = places_[(x + 3 * y + 5 * z) & (kPlaces - 1)];
    if (place.known && place.x == x && place.y == y && place.z == z) return place.number;
    const int64_t row = map_.find({corner_[0] + x, corner_[1] + y, corner_[2] + z});
    place = {true, x, y, z, row < 0 ? -1 : scratch_.update_of_row[row]};
    return place.number;
  }

 private:
  static constexpr int kPlaces = 64;
  struct Place {
    bool known = false;
    int32_t x, y, z, number;
  };
  const Tsdf& map_;
  const FusionScratch& scratch_;
  const Vec3i corner_;
  Place places_[kPlaces];
};

// While it lives, scratch.update_of_row tells the updates of rows.
class ListedRows {
 public:
  ListedRows(const Tsdf& map, FusionScratch& scratch) : scratch_(scratch) {
    scratch.update_of_row.resize(std::max(scratch.update_of_row.size(), map.size()), -1);
    for (std::size_t n = 0; n < scratch.updates.size(); ++n)
      scratch.update_of_row[scratch.updates[n].row] = static_cast<int32_t>(n);
  }
  ~ListedRows() {
    for (const FusionScratch::Update& update : scratch_.updates) scratch_.update_of_row[update.row] = -1;
  }
  ListedRows(const ListedRows&) = delete;
  ListedRows& operator=(const ListedRows&) = delete;

 private:
  FusionScratch& scratch_;
};

}  // namespace ggslam::volumes
