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

constexpr int kTile = 4;        // pixels along an edge of the depth pyramid's smallest tiles
constexpr int kErosion = 2;     // pixels: what is looked through must be so in this neighbourhood
constexpr float kNear = 0.02f;  // metres; what is nearer is not projected

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

// Blocks that the view tells about: those with a surface, those that are free, and those of which parts are, unless
// they are known to be free.
class CandidateSearch {
 public:
  CandidateSearch(const Tsdf& map, const FusionInput& input, const FusionSettings& settings,
                  const FusionImages& images);

  // Cubes of many blocks that enclose what is in view.
  std::size_t cells() const { return static_cast<std::size_t>(count_[0]) * count_[1] * count_[2]; }
  // Appends the candidates of a cell.
  void search(std::size_t cell, CandidateCount& count, std::vector<Candidate>& out) const;

 private:
  static constexpr int kMostCells = 4096;
  struct Footprint {
    int u0, v0, u1, v1;  // tiles, inclusive
    bool whole;          // nothing is cut off at the image's border or near the camera
  };
  struct Cube {
    Vec3f centre;     // in the camera's frame
    float near, far;  // depth of its nearest and farthest corner
    Vec3f offset;     // centre from the camera along the map's axes
    float half;       // of the edge
  };
  const Tsdf& map_;
  const FusionInput& in_;
  const FusionSettings& settings_;
  const FusionImages& images_;
  double block_;         // edge, metres
  int cell_ = 4;         // edge of a cell in blocks
  float extent_[3];      // half extents of a block along the camera's axes
  Mat3d rotation_;       // of T_camera_map
  Vec3d translation_;
  Vec3d position_;       // of the camera
  Mat3f axes_;           // of the camera in the map
  float spread_[3];      // along the map's axes at z = 1, of one pixel
  Vec3i first_, count_;

  void descend(BlockCoordinates at, int side, CandidateCount& count, std::vector<Candidate>& out) const;
  // Whether a cube of side^3 blocks has some that are looked at.
  bool wanted(BlockCoordinates at, int side) const;
  void emit(BlockCoordinates at, Sight sight, CandidateCount& count, std::vector<Candidate>& out) const;
  void emit_free(BlockCoordinates at, int side, CandidateCount& count, std::vector<Candidate>& out) const;
  Cube cube(BlockCoordinates at, int side) const;
  bool footprint(const Cube& cube, int side, Footprint& out) const;
  bool meets(int level, int u, int v, const Cube& cube, float& z0, float& z1) const;
  unsigned look(int level, int u, int v, const Footprint& area, const Cube& cube) const;
  unsigned look_at_pixels(int u, int v, float low, float high) const;
  unsigned look_beyond(int u, int v, float low, float high) const;
  float valid_share(const Footprint& area) const;
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
