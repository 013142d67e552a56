// SPDX-License-Identifier: Apache-2.0
// How far the goal about is from a cell, around what stands in between: a search from the goal over patches of cells,
// which goes on as far as the search over cells asks.
#pragma once
#include <algorithm>
#include <cmath>
#include <vector>

#include "driving/cost_queue.hpp"
#include "driving/way_patches.hpp"

namespace ggslam::driving {

// The length of the shortest way over cells that all may be entered, in cells.
inline float steps_between(const Vec3<float>& a, const Vec3<float>& b) {
  const float x = std::fabs(a[0] - b[0]), y = std::fabs(a[1] - b[1]), z = std::fabs(a[2] - b[2]);
  const float most = std::max(std::max(x, y), z), least = std::min(std::min(x, y), z);
  return most + 0.41421356f * (x + y + z - most - least) + 0.31783725f * least;
}

class WayGuide {
 public:
  explicit WayGuide(WayGrid& grid) : grid_(grid), patches_(grid) {}

  void begin(const WayCost& cost, const Vec3<float>& start, const Vec3<float>& goal);
  // Anew, on the grid as it is now.
  void begin_again();
  // A cell that the goal can be reached from.
  void add_goal(const Vec3i& cell);

  // What is left to the goal, in cells; infinite: no way leads there. `most` patches are looked at for all questions.
  float left(CellPlace p, int64_t most) {
    const int patch = patches_.index_of(p.index);
    WayBlock& b = grid_.block(p.row);
    if (!b.guide || (b.guided[patch] != version_ && b.guided[patch] != bound_version_)) fill(p, patch, most);
    return b.guide[static_cast<std::size_t>(p.index)];
  }
  // Whether what was told of a cell's patch may be told better now.
  bool is_old(CellPlace p) const {
    return grid_.block(p.row).guided[patches_.index_of(p.index)] != version_;
  }
  std::size_t bytes() const { return patches_.bytes() + nodes_.capacity() * sizeof(Node); }
  int64_t expanded() const { return expanded_; }  // patches, since it began

 private:
  static constexpr uint32_t kFirstBound = uint32_t{1} << 31;
  struct Node {
    float value;      // cost to the goal
    uint32_t search;  // of which search this is
    bool done;
  };
  Node& node(int64_t patch);
  void reach(int64_t patch, float value);
  void step();
  void fill(CellPlace p, int index, int64_t most);
  bool fill(int64_t patch, int64_t most, float* left);

  WayGrid& grid_;
  WayPatches patches_;
  WayCost cost_{};
  Vec3<float> start_{}, goal_{};
  std::vector<Vec3i> goals_;
  std::vector<int64_t> goal_patches_, around_;
  CostQueue queue_;
  std::vector<Node> nodes_;
  std::vector<float> places_;  // five numbers each, see `ways_over_places`
  uint32_t version_ = 0, bound_version_ = kFirstBound;  // of what is known, and of what is known to be left at least
  int64_t expanded_ = 0;
};

}  // namespace ggslam::driving
