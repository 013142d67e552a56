// SPDX-License-Identifier: Apache-2.0
#include "volumes/block_table.hpp"

namespace ggslam::volumes {

std::size_t BlockTable::insert(BlockCoordinates at) {
  std::size_t p = block_place(view(), at);
  if (rows_[p] >= 0) return rows_[p];
  at_.push_back(at);
  if (2 * at_.size() > rows_.size()) {
    rows_.assign(2 * rows_.size(), -1);
    for (std::size_t row = 0; row < at_.size(); ++row)
      rows_[block_place(view(), at_[row])] = static_cast<int32_t>(row);
  } else {
    rows_[p] = static_cast<int32_t>(at_.size() - 1);
  }
  return at_.size() - 1;
}

void BlockTable::erase(std::size_t row) {
  const std::size_t mask = rows_.size() - 1;
  std::size_t hole = block_place(view(), at_[row]);
  rows_[hole] = -1;
  // Those behind it in its run of places move up, so that they are still found.
  for (std::size_t p = (hole + 1) & mask; rows_[p] >= 0; p = (p + 1) & mask) {
    const std::size_t home = block_hash(at_[rows_[p]]) & mask;
    if (((p - home) & mask) < ((p - hole) & mask)) continue;
    rows_[hole] = rows_[p];
    rows_[p] = -1;
    hole = p;
  }
  const std::size_t last = at_.size() - 1;
  if (row != last) {
    rows_[block_place(view(), at_[last])] = static_cast<int32_t>(row);
    at_[row] = at_[last];
  }
  at_.pop_back();
}

void BlockTable::clear() {
  at_.clear();
  rows_.assign(1024, -1);
}

}  // namespace ggslam::volumes
