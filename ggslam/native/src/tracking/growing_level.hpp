// SPDX-License-Identifier: Apache-2.0
// One level of a target that grows in versions. A block that changes is put at a new place, beside the old one, which
// stays what it was for those who hold an earlier version. Its place is used again once nobody holds one.
#pragma once
#include <algorithm>
#include <array>
#include <deque>
#include <memory>
#include <vector>

#include "tracking/block_lookup.hpp"

namespace ggslam {

constexpr uint32_t kFirstVersion = 1;

// An array that is longer from time to time while others read it: those go on reading the one that they were handed.
template <typename T>
class SharedArray {
 public:
  T* get() const { return data_.get(); }
  const std::shared_ptr<T[]>& data() const { return data_; }
  std::size_t room() const { return room_; }

  void reserve(std::size_t used, std::size_t need) {
    if (need <= room_) return;
    const std::size_t room = std::max({need, 2 * room_, std::size_t{1024}});
    std::shared_ptr<T[]> larger(new T[room]);
    std::copy_n(data_.get(), used, larger.get());
    data_ = std::move(larger), room_ = room;
  }

 private:
  std::shared_ptr<T[]> data_;
  std::size_t room_ = 0;
};

// What a version of a level consists of; whoever holds it may read it while later versions are made.
struct HeldLevel {
  std::shared_ptr<Voxel[]> voxels;
  std::shared_ptr<VoxelMoments[]> moments;
  std::shared_ptr<VoxelBlock[]> blocks;
  std::shared_ptr<int32_t[]> previous, slot_block;
  std::shared_ptr<uint64_t[]> slot_key, keys;  // `keys`: of its blocks, in the order in which they came
  uint64_t slot_mask = 0;
  std::size_t block_count = 0, voxel_count = 0;
  std::size_t places = 0;  // voxels lie at indices below
  float size = 1;
  uint32_t version = 0;

  VoxelLevelView view() const;
};

// A block in which voxels change.
struct ChangedBlock {
  uint64_t key, added;  // voxels that something is added to
};

// A block that was put at a new place. Its moments are to be filled in.
struct PlacedBlock {
  uint64_t key, added;
  VoxelBlock now, before;  // `before`: nothing occupied where the block is new
};

class GrowingLevel {
 public:
  explicit GrowingLevel(float size) : size_(size) {}

  // Puts the blocks at new places as of `version`, and with `spread` those beside them whose voxels touch changed ones.
  std::vector<PlacedBlock> place(const std::vector<ChangedBlock>& changed, bool spread, uint32_t version);

  // As a new block of the first version, behind those that are there; `voxels` is null if they have no shapes.
  void append(uint64_t key, uint64_t occupied, const VoxelMoments* moments, const Voxel* voxels);

  // The newest version, which is `version`.
  HeldLevel hold(uint32_t version) const;
  // Has a version lie where the newest does.
  void move(HeldLevel& held) const;
  VoxelMoments* moments() const { return moments_.get(); }

  // Takes blocks whose voxels have no shape yet and that the version has; they count as shaped from now on.
  std::vector<VoxelBlock> take_unshaped(uint32_t version);

  // Blocks that were replaced by `version` or earlier ones are read no more.
  void collect(uint32_t version);

  // Keys of blocks that changed after `version`, up to and with `last`; false: it is not known any more.
  bool changes(uint32_t version, uint32_t last, std::vector<uint64_t>& keys) const;

 private:
  struct Replaced {
    uint32_t version;  // that has another block instead
    int32_t block;
  };
  struct Change {
    uint32_t version;
    std::vector<uint64_t> keys;
  };

  // Blocks to place, and the indices of those that they replace, or -1.
  struct Choice {
    std::vector<PlacedBlock> placed;
    std::vector<int32_t> before;
  };

  void choose_beside(const std::vector<ChangedBlock>& changed, uint32_t version, Choice& choice);
  void make_room(std::size_t more);
  void make_table(std::size_t keys);
  uint32_t take_place(uint64_t occupied);
  uint32_t append_place(std::size_t voxels);
  int32_t new_block(uint64_t key, const VoxelBlock& block, int32_t previous);
  void publish(uint64_t key, int32_t block);
  VoxelLevelView newest() const;

  float size_;
  SharedArray<Voxel> voxels_;
  SharedArray<VoxelMoments> moments_;
  SharedArray<VoxelBlock> blocks_;
  SharedArray<int32_t> previous_;
  SharedArray<uint64_t> keys_;
  std::shared_ptr<uint64_t[]> slot_key_;
  std::shared_ptr<int32_t[]> slot_block_;
  uint64_t slot_mask_ = 0;
  std::size_t block_room_ = 0, places_ = 0;  // indices of blocks and voxels that were ever used
  std::size_t key_count_ = 0, voxel_count_ = 0;  // of the newest version
  std::vector<uint64_t> key_of_;    // of each block
  std::vector<char> shaped_, listed_;  // of each block: its voxels have shapes; it is in `unshaped_`
  std::vector<uint32_t> chosen_;    // of each block: the version in which it was replaced last
  std::vector<int32_t> unshaped_, free_blocks_;
  std::array<std::vector<uint32_t>, 17> free_places_;  // by room in units of 4 voxels
  std::deque<Replaced> replaced_;
  std::deque<Change> changes_;
};

}  // namespace ggslam
