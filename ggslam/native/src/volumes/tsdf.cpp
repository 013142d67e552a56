// SPDX-License-Identifier: Apache-2.0
#include "volumes/tsdf.hpp"

#include <algorithm>

namespace ggslam::volumes {
namespace {

bool same(BlockCoordinates a, BlockCoordinates b) { return a.x == b.x && a.y == b.y && a.z == b.z; }

std::size_t hash(BlockCoordinates at) {
  uint64_t h = static_cast<uint32_t>(at.x) * 0x9E3779B97F4A7C15ull;
  h = (h ^ (h >> 29)) + static_cast<uint32_t>(at.y) * 0xBF58476D1CE4E5B9ull;
  h = (h ^ (h >> 31)) + static_cast<uint32_t>(at.z) * 0x94D049BB133111EBull;
  return static_cast<std::size_t>(h ^ (h >> 32));
}

}  // namespace

Tsdf::Tsdf(float voxel_, float truncation_, float max_weight_)
    : voxel(voxel_), truncation(truncation_), max_weight(max_weight_) {
  clear();
}

std::size_t Tsdf::bytes() const {
  return pool_.size() * kChunk * sizeof(VoxelBlock) + blocks_.capacity() * sizeof(Block) +
         table_.capacity() * sizeof(int32_t) + free_slots_.capacity() * sizeof(int32_t);
}

// Where a block stands in the table, or the empty place where it would.
std::size_t Tsdf::place(BlockCoordinates at) const {
  std::size_t p = hash(at) & mask_;
  while (table_[p] >= 0 && !same(blocks_[table_[p]].at, at)) p = (p + 1) & mask_;
  return p;
}

int64_t Tsdf::find(BlockCoordinates at) const { return table_[place(at)]; }

std::size_t Tsdf::insert(BlockCoordinates at) {
  std::size_t p = place(at);
  if (table_[p] >= 0) return table_[p];
  if (2 * (blocks_.size() + 1) > table_.size()) {
    grow();
    p = place(at);
  }
  table_[p] = static_cast<int32_t>(blocks_.size());
  Block block;
  block.at = at;
  blocks_.push_back(block);
  return blocks_.size() - 1;
}

void Tsdf::grow() {
  table_.assign(2 * table_.size(), -1);
  mask_ = table_.size() - 1;
  for (std::size_t row = 0; row < blocks_.size(); ++row) table_[place(blocks_[row].at)] = static_cast<int32_t>(row);
}

VoxelBlock* Tsdf::densify(Block& block) {
  if (block.slot >= 0) return voxels(block);
  if (free_slots_.empty()) {
    if (slots_used_ == pool_.size() * kChunk) pool_.emplace_back(new VoxelBlock[kChunk]);
    block.slot = static_cast<int32_t>(slots_used_++);
  } else {
    block.slot = free_slots_.back();
    free_slots_.pop_back();
  }
  VoxelBlock* v = voxels(block);
  *v = VoxelBlock{};
  std::fill_n(v->value, kVoxels, kFreeValue);
  std::fill_n(v->weight, kVoxels, block.free_weight);
  return v;
}

void Tsdf::collapse(Block& block, uint16_t weight) {
  if (block.slot >= 0) free_slots_.push_back(block.slot);
  block.slot = -1;
  block.free_weight = weight;
}

void Tsdf::erase(std::size_t row) {
  collapse(blocks_[row], 0);
  std::size_t hole = place(blocks_[row].at);
  table_[hole] = -1;
  // Those behind it in its run of places move up, so that they are still found.
  for (std::size_t p = (hole + 1) & mask_; table_[p] >= 0; p = (p + 1) & mask_) {
    const std::size_t home = hash(blocks_[table_[p]].at) & mask_;
    if (((p - home) & mask_) < ((p - hole) & mask_)) continue;
    table_[hole] = table_[p];
    table_[p] = -1;
    hole = p;
  }
  const std::size_t last = blocks_.size() - 1;
  if (row != last) {
    table_[place(blocks_[last].at)] = static_cast<int32_t>(row);
    blocks_[row] = blocks_[last];
  }
  blocks_.pop_back();
}

void Tsdf::clear() {
  blocks_.clear();
  pool_.clear();
  free_slots_.clear();
  slots_used_ = 0;
  table_.assign(1024, -1);
  mask_ = table_.size() - 1;
  ++revision;
}

}  // namespace ggslam::volumes
