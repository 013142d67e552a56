// SPDX-License-Identifier: Apache-2.0
#include "volumes/voxel_masks.hpp"

#include <cstring>

#include "common/guard.hpp"

namespace ggslam {
namespace {
constexpr int kFirstBits = 12;
}

VoxelMasks::VoxelMasks() : table_(std::size_t{1} << kFirstBits, -1), shift_(64 - kFirstBits) {}

void VoxelMasks::clear() {
  table_.assign(table_.size(), -1);
  codes_.clear();
  last_code_ = kNone;
}

// Where a block's index stands, or the free place where it would.
std::size_t VoxelMasks::place(std::uint64_t code) const {
  const std::size_t last = table_.size() - 1;
  std::size_t i = (code * 0x9e3779b97f4a7c15u) >> shift_;
  while (table_[i] >= 0 && codes_[table_[i]] != code) i = (i + 1) & last;
  return i;
}

std::uint64_t* VoxelMasks::block(std::uint64_t code) {
  const std::size_t i = place(code);
  if (table_[i] >= 0) return const_cast<std::uint64_t*>(words(table_[i]));
  if (codes_.size() >= most_) refuse("scan: it passes more than %zu blocks of 8^3 voxels; limit its range", most_);
  if (2 * (codes_.size() + 1) > table_.size()) {
    grow();
    return block(code);
  }
  const std::size_t index = codes_.size();
  if (index / kChunk == chunks_.size()) chunks_.emplace_back(new std::uint64_t[kChunk * kMaskWords]);
  codes_.push_back(code);
  table_[i] = static_cast<std::int32_t>(index);
  auto* fresh = const_cast<std::uint64_t*>(words(index));
  std::memset(fresh, 0, kMaskWords * sizeof(std::uint64_t));
  return fresh;
}

const std::uint64_t* VoxelMasks::find(std::uint64_t code) const {
  const std::int32_t index = table_[place(code)];
  return index < 0 ? nullptr : words(index);
}

void VoxelMasks::grow() {
  table_.assign(2 * table_.size(), -1);
  --shift_;
  for (std::size_t b = 0; b < codes_.size(); ++b) table_[place(codes_[b])] = static_cast<std::int32_t>(b);
}

std::size_t VoxelMasks::voxels() const {
  std::size_t n = 0;
  for (std::size_t b = 0; b < blocks(); ++b)
    for (int w = 0; w < kMaskWords; ++w) n += __builtin_popcountll(words(b)[w]);
  return n;
}

void VoxelMasks::unite(const VoxelMasks& other) {
  for (std::size_t b = 0; b < other.blocks(); ++b) {
    std::uint64_t* own = block(other.code(b));
    for (int w = 0; w < kMaskWords; ++w) own[w] |= other.words(b)[w];
  }
}

}  // namespace ggslam
