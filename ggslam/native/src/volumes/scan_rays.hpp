// SPDX-License-Identifier: Apache-2.0
// The voxels that one scan sees: those its rays pass (free) and those its points lie in (occupied).
#pragma once
#include <memory>
#include <vector>

#include "common/context.hpp"
#include "volumes/voxel_masks.hpp"

namespace ggslam {

constexpr int kRayBatch = 256;

// Rays ready to be walked, one after another in each array. A ray stands at a distance t from the origin where it
// enters the next voxel along each axis; `step` adds or subtracts one from an axis of a Morton code (kernels/volumes/
// ray_walk.cpp).
struct RayBatch {
  int count = 0;
  alignas(64) double t[3][kRayBatch] = {}, delta[3][kRayBatch] = {}, length[kRayBatch] = {};
  alignas(64) std::int64_t step[3][kRayBatch] = {}, end[kRayBatch] = {};
};

// A block's words, found or made; a plain function, so that kernels of every instruction set share one.
std::uint64_t* free_block(VoxelMasks& masks, std::uint64_t code);

struct ScanSettings {
  float origin[3];
  double max_range;  // metres; negative: none
  bool quantize;     // one ray per voxel, to its centre; otherwise one per point
  bool last_voxel;   // rays cut at the range free the voxel that they end in, if they go on behind it
  bool count = false;  // where `quantize`: whether points are counted
};

// How many points lie in each voxel of a set.
struct PointCounts {
  const VoxelMasks* voxels = nullptr;  // null: nothing was counted
  std::vector<std::size_t> first;      // the number of the first voxel of each word
  std::vector<std::int32_t> counts;    // in the order of for_each_voxel

  void take(const std::vector<std::int64_t>& codes, const VoxelMasks& voxels);
  std::int32_t of(std::uint64_t code) const {  // of a voxel of the set
    const std::size_t word = voxels->index(code >> 9) * kMaskWords + ((code >> 6) & 7);
    const std::uint64_t below = (std::uint64_t{1} << (code & 63)) - 1;
    const std::uint64_t bits = voxels->words(word / kMaskWords)[word % kMaskWords];
    return counts[first[word] + __builtin_popcountll(bits & below)];
  }
};

class Scan {
 public:
  // Looks at n points (float [n, 3], world); false if the origin is outside the grid. Points that are not finite or
  // outside the grid are left out. Free voxels are not taken out of `free` where they are occupied as well. Rays to
  // `empty` points free all on their way, their end included.
  bool cast(Context& context, const KeyGrid& grid, const ScanSettings& settings, const float* points, std::size_t n,
            const std::vector<float>& empty = {});
  const VoxelMasks& free() const { return workers_[0]->free; }
  const VoxelMasks& occupied() const { return workers_[0]->occupied; }
  std::size_t rays() const { return rays_; }
  // Of the occupied voxels; null if points were not counted.
  const PointCounts* counts() const { return counts_.voxels ? &counts_ : nullptr; }

 private:
  struct Worker {
    VoxelMasks free, occupied;
    RayBatch batch;
    std::size_t rays = 0;
  };
  void cast_to(Context& context, const KeyGrid& grid, const ScanSettings& settings, const float* points, std::size_t n,
               bool empty);

  std::vector<std::unique_ptr<Worker>> workers_;
  std::size_t rays_ = 0;
  VoxelMasks voxels_;
  std::vector<float> centres_;
  std::vector<std::int64_t> codes_;
  PointCounts counts_;
};

// The distinct voxels of n points, as Morton codes per point (-1: none) and as a set.
void quantize(Context& context, const KeyGrid& grid, const float* points, std::size_t n,
              std::vector<std::int64_t>& codes, VoxelMasks& voxels);

// Calls f(code) for each voxel of a set, block by block in the order they were found.
template <class F>
void for_each_voxel(const VoxelMasks& masks, F f) {
  for (std::size_t b = 0; b < masks.blocks(); ++b)
    for (int w = 0; w < kMaskWords; ++w)
      for (std::uint64_t left = masks.words(b)[w]; left != 0; left &= left - 1)
        f(masks.code(b) << 9 | static_cast<std::uint64_t>(w) << 6 | __builtin_ctzll(left));
}

}  // namespace ggslam
