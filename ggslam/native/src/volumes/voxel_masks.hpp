// SPDX-License-Identifier: Apache-2.0
// A set of voxels: a hash of blocks of 8^3 voxels, 512 bits each.
#pragma once
#include <cstdint>
#include <memory>
#include <vector>

#include "volumes/occupancy_keys.hpp"

namespace ggslam {

constexpr int kMaskWords = kBlockVoxels / 64;

class VoxelMasks {
 public:
  VoxelMasks();
  void clear();
  // From now on a block beyond so many is refused by an InputError.
  void limit(std::size_t most_blocks) { most_ = most_blocks; }

  // Words of a block, all zero when it is new. The pointer stays good until clear().
  std::uint64_t* block(std::uint64_t code);
  const std::uint64_t* find(std::uint64_t code) const;  // null: no voxel of it

  void insert(std::uint64_t voxel) {
    const std::uint64_t code = voxel >> 9;
    if (code != last_code_) last_words_ = block(last_code_ = code);
    last_words_[(voxel >> 6) & 7] |= std::uint64_t{1} << (voxel & 63);
  }

  std::size_t blocks() const { return codes_.size(); }
  std::uint64_t code(std::size_t i) const { return codes_[i]; }
  std::size_t index(std::uint64_t code) const { return static_cast<std::size_t>(table_[place(code)]); }  // of its block
  const std::uint64_t* words(std::size_t i) const { return chunks_[i / kChunk].get() + i % kChunk * kMaskWords; }
  std::size_t voxels() const;
  void unite(const VoxelMasks& other);

 private:
  static constexpr std::size_t kChunk = 1024;
  static constexpr std::uint64_t kNone = ~std::uint64_t{0};
  std::size_t place(std::uint64_t code) const;
  void grow();

  std::vector<std::int32_t> table_;  // open addressing, index of a block or -1
  int shift_;
  std::size_t most_ = ~std::size_t{0};
  std::vector<std::uint64_t> codes_;
  std::vector<std::unique_ptr<std::uint64_t[]>> chunks_;
  std::uint64_t last_code_ = kNone;
  std::uint64_t* last_words_ = nullptr;
};

}  // namespace ggslam
