// SPDX-License-Identifier: Apache-2.0
// The search for the blocks that a view tells about.
#pragma once
#include <vector>

#include "native/formulas/block_sight.hpp"
#include "volumes/tsdf_fusion.hpp"

namespace ggslam::volumes {

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
  const Tsdf& map_;
  const FusionInput& in_;
  const FusionSettings& settings_;
  const FusionImages& images_;
  plain::BlockCamera camera_;
  int cell_ = 4;  // edge of a cell in blocks
  Vec3i first_, count_;

  void descend(BlockCoordinates at, int side, CandidateCount& count, std::vector<Candidate>& out) const;
  // Whether a cube of side^3 blocks has some that are looked at.
  bool wanted(BlockCoordinates at, int side) const;
  void emit(BlockCoordinates at, Sight sight, CandidateCount& count, std::vector<Candidate>& out) const;
  void emit_free(BlockCoordinates at, int side, CandidateCount& count, std::vector<Candidate>& out) const;
  plain::SeenCube cube(BlockCoordinates at, int side) const { return seen_cube(camera_, at.x, at.y, at.z, side); }
  unsigned look(int level, int u, int v, const plain::Footprint& area, const plain::SeenCube& cube) const;
  unsigned look_at_pixels(int u, int v, float low, float high) const;
  float valid_share(const plain::Footprint& area) const;
};

}  // namespace ggslam::volumes
