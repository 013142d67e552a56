// SPDX-License-Identifier: Apache-2.0
#include "volumes/tsdf.hpp"

#include <algorithm>

namespace ggslam::volumes {

Tsdf::Tsdf(float voxel_, float truncation_, float max_weight_)
    : voxel(voxel_), truncation(truncation_), max_weight(max_weight_) {
  clear();
}

std::size_t Tsdf::bytes() const {
  const std::size_t chunk = kChunk * sizeof(VoxelBlock), of_points = kChunk * sizeof(PointBlock);
  return pool_.size() * chunk + points_.size() * of_points + blocks_.capacity() * sizeof(Block) + table_.bytes() +
         free_slots_.capacity() * sizeof(int32_t);
}

int64_t Tsdf::find(BlockCoordinates at) const { return table_.find(at); }

std::size_t Tsdf::insert(BlockCoordinates at) {
  const std::size_t row = table_.insert(at);
  if (row == blocks_.size()) {
    blocks_.emplace_back();
    blocks_.back().at = at;
  }
  return row;
}

VoxelBlock* Tsdf::densify(Block& block) {
  if (block.slot >= 0) return voxels(block);
  if (free_slots_.empty()) {
    if (slots_used_ == pool_.size() * kChunk) add_chunk();
    block.slot = static_cast<int32_t>(slots_used_++);
  } else {
    block.slot = free_slots_.back();
    free_slots_.pop_back();
  }
  VoxelBlock* v = voxels(block);
  *v = VoxelBlock{};
  std::fill_n(v->value, kVoxels, kFreeValue);
  std::fill_n(v->weight, kVoxels, block.free_weight);
  if (PointBlock* p = points(block)) {
    *p = PointBlock{};
    std::fill_n(p->hits, kVoxels, static_cast<uint8_t>(block.free_weight > 0 ? kLeastHits : kNeverSeen));
  }
  return v;
}

void Tsdf::add_chunk() {
  pool_.emplace_back(new VoxelBlock[kChunk]);
  if (counts_points_) points_.emplace_back(new PointBlock[kChunk]);
}

void Tsdf::count_points() {
  counts_points_ = true;
  while (points_.size() < pool_.size()) points_.emplace_back(new PointBlock[kChunk]());
}

void Tsdf::collapse(Block& block, uint16_t weight) {
  if (block.slot >= 0) free_slots_.push_back(block.slot);
  block.slot = -1;
  block.free_weight = weight;
}

void Tsdf::erase(std::size_t row) {
  collapse(blocks_[row], 0);
  table_.erase(row);
  blocks_[row] = blocks_.back();
  blocks_.pop_back();
}

void Tsdf::clear() {
  blocks_.clear();
  pool_.clear();
  points_.clear();
  free_slots_.clear();
  slots_used_ = 0;
  table_.clear();
  ++revision;
}

}  // namespace ggslam::volumes
