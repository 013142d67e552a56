// SPDX-License-Identifier: Apache-2.0
// What the parts of the fusion of a depth image share.
#pragma once
#include <cstdint>
#include <vector>

#include "common/vector.hpp"
#include "abi/core/volumes.hpp"
#include "volumes/tsdf.hpp"

namespace ggslam {
struct Context;
}

namespace ggslam::volumes {

// Smallest and largest depth in tiles of kTile x 2^level pixels; (inf, 0) where there is none.
struct DepthTile {
  float low, high;
};

struct DepthPyramid {
  struct Level {
    int width, height;
    std::vector<DepthTile> tiles;
  };
  std::vector<Level> levels;
  // [tile rows + 1, tile columns + 1], number of pixels with depth above and left of a tile
  std::vector<int32_t> valid;
};

// The prepared images: depth with 0 for none, with room to read a row and a pixel past the end; the smallest depth
// within kErosion pixels, infinite for none; colour as red + 256 green + 65536 blue. Depth beyond the range is no
// surface's, but proves what lies before it free: it is kept, cut off two truncations beyond the range, so that all voxels
// that a surface in range has touched have it behind them.
struct FusionImages {
  std::vector<float> depth, eroded_rows, eroded;
  std::vector<int32_t> color;
  DepthPyramid pyramid;
  float nearest, farthest;  // of all depth; (inf, 0) if there is none
};

enum class Sight : uint8_t {
  surface,  // depth lies within the truncation of the block
  free,     // the block is wholly in view and all depth lies behind it
  partial,  // a part of it is in view and free
  passed    // the range ends in it: what has voxels there is free up to the range
};

struct Candidate {
  BlockCoordinates at;
  Sight sight;
  float z;      // depth of the block's centre
  int32_t row;  // in the map; -1: none yet
};

// How many candidates a thread has found. A view may not have any number: a camera that does not belong to the images, or
// voxels far too small for the range, would fill all memory.
struct CandidateCount {
  std::size_t all = 0, with_voxels = 0;

  // Throws an InputError when there are too many.
  void add(std::size_t more, std::size_t more_with_voxels) {
    all += more, with_voxels += more_with_voxels;
    if (all > kMost) refuse_view(kMost, "blocks");
    if (with_voxels > kMostWithVoxels) refuse_view(kMostWithVoxels, "blocks that need voxels");
  }

 private:
  static constexpr std::size_t kMost = std::size_t{1} << 23, kMostWithVoxels = std::size_t{1} << 20;
  [[noreturn]] static void refuse_view(std::size_t most, const char* what);
};

// What happened to a block's voxels; bits.
enum : unsigned { kChanged = 1, kInBand = 2, kAllFree = 4, kNoneSeen = 8 };

struct RaySum;

// A block to be updated, for the kernel.
struct VoxelUpdate {
  const float* depth;
  const float* eroded;     // null: no clearing
  const int32_t* color;    // null: none
  const uint16_t* labels;  // null: none
  int32_t width, height;
  float fx, fy, cx, cy;
  float origin[3];         // of the block's first voxel centre, camera frame
  float step[3][3];        // from voxel to voxel along the block's axes, camera frame
  float truncation, voxel, edge, clearing;
  float max_depth;         // depth beyond it tells of free space alone
  float weight_scale;      // 65535 / largest weight
  float max_free_weight;   // in 65535ths of the largest
  PointBlock* points;      // of the block; null: not counted
  uint8_t* octants;        // [kVoxels], those of the block that the view has points in, which are cleared; null: none
  RaySum* rays;            // [kVoxels], what rays told the block, which is cleared; null: nothing
  bool rays_alone;         // voxels near the surface that no ray passed stay as they are
  int32_t least_rays;      // that count; fewer: the depth at the voxel's projection does
};

// A row of the depth image as octants of voxels from a corner of blocks: at depth z of column u they are floor(origin + z
// (first + u step)) along the map's axes.
struct OctantRow {
  static constexpr int32_t kNone = INT32_MIN;
  static constexpr int kSlack = 16;  // so many elements after a row's may be read, and written in `out`
  const float* depth;
  int width;
  float max_depth;  // farther depth is none
  float origin[3], first[3], step[3];
  const int32_t* above[3];  // [width], octants of the row before
  int32_t* out[3];          // [width], with kNone before the first; the first axis: kNone where there is no depth
  uint64_t* fresh;          // bits: whether a pixel has an octant, which is not that of the pixel on its left or above it
};

FusionStats integrate(Tsdf& map, FusionScratch& scratch, Context& context, const FusionInput& input,
                      const FusionSettings& settings);

// Multiplies the weights of blocks that are not frozen (nor, if those are to be spared, in the last view); voxels whose
// weight falls below `least` are forgotten, and blocks without others erased. Returns how many.
int64_t decay(Tsdf& map, FusionScratch& scratch, Context& context, float factor, int least, bool spare_in_view);

}  // namespace ggslam::volumes
