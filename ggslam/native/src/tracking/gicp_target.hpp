// SPDX-License-Identifier: Apache-2.0
// What a frame is aligned to: the map's Gaussians gathered in voxels at two levels.
#pragma once
#include <memory>
#include <vector>

#include "tracking/growing_target.hpp"
#include "tracking/target_part.hpp"

namespace ggslam {

struct VoxelLevel {
  std::vector<Voxel> voxels;
  std::vector<VoxelMoments> moments;
  std::vector<VoxelBlock> blocks;
  std::vector<uint64_t> block_keys;  // in the order of `blocks`
  std::vector<uint64_t> slot_key;
  std::vector<int32_t> slot_block;
  float size = 1;

  // Fills slot_key and slot_block from block_keys.
  void index_blocks();
  // The block of a key, or -1.
  int block_of(uint64_t key) const { return find_block(view(), key); }
  VoxelLevelView view() const;
};

// A level as it is read, whatever holds it.
struct LevelContents {
  VoxelLevelView view;  // look-ups ask for a finished target
  const VoxelMoments* moments;  // by index, as the view's voxels
  const uint64_t* keys;
  std::size_t block_count, voxel_count, places;  // indices of voxels lie below `places`
  bool in_order;  // whether block i is that of key i

  // Calls visit(key, block) in the order of the keys.
  template <typename Visit>
  void for_each_block(const Visit& visit) const {
    for (std::size_t b = 0; b < block_count; ++b)
      visit(keys[b], view.blocks[in_order ? static_cast<int>(b) : find_block(view, keys[b])]);
  }
};

struct BlockSource {
  const TargetPart* part;
  uint32_t block;
};

// What a composed target is made of: for each fine block its place in the order and, by rank, the parts that have it.
struct Composition {
  std::vector<std::shared_ptr<const TargetPart>> parts;
  std::vector<uint64_t> orders;
  std::vector<uint32_t> source_end;  // sources of block i: from source_end[i - 1] (0 for the first) to source_end[i]
  std::vector<BlockSource> sources;
};

struct GicpTarget {
  uint64_t number = new_target_number();
  VoxelLevel fine, coarse;  // empty if grown
  std::unique_ptr<TargetVersion> grown;  // null: it was not made from a base
  Composition composition;  // empty unless composed
  TargetSettings shaped_with{};  // of the voxels' shapes...
  bool shaped = false;           // ...if `finish` made them

  LevelContents contents(int level) const;
  bool is_finished() const;

  // Replaces the contents by what `base` (may be null) holds and the Gaussians of `input`. `base` must have been built
  // with the same settings; the cost goes with the blocks that the Gaussians lie in, if nothing else was built on it.
  // The result does not depend on the number of threads.
  void build(Context& context, const GicpTarget* base, const TargetInput& input, const TargetSettings& settings,
             const GicpTarget* like = nullptr);

  // The two halves of `build`: blocks and moments of the voxels, which is all that a `base` needs; then their shapes.
  // Shapes of voxels that are in `like` (finished; may be null) with the same surroundings are copied from there: the
  // result is the same, to the bit.
  void gather(Context& context, const GicpTarget* base, const TargetInput& input, const TargetSettings& settings);
  void finish(Context& context, const TargetSettings& settings, const GicpTarget* like = nullptr);

  // Replaces the contents by the union of `parts`, all of the same settings and of different ranks. What of it is as in
  // `before` (composed, too, with the same settings; may be null) is copied from there. The result depends on the parts
  // alone: not on `before`, their order or the number of threads. Not to be used as `base`.
  void compose(Context& context, const GicpTarget* before, std::vector<std::shared_ptr<const TargetPart>> parts,
               const TargetSettings& settings);
};

// Throws an InputError for what cannot be.
void check_target(const TargetInput* input, const TargetSettings* settings);

}  // namespace ggslam
