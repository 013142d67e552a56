// SPDX-License-Identifier: Apache-2.0
// Searches on a grid: A* for the cheapest way of a ball, guided by a search over patches of cells, and the way with the
// largest least clearance.
#pragma once
#include <algorithm>
#include <queue>
#include <vector>

#include "abi/core/planning.hpp"
#include "driving/cost_queue.hpp"
#include "driving/way_cost.hpp"
#include "driving/way_grid.hpp"
#include "driving/way_guide.hpp"

namespace ggslam::driving {

class WaySearch {
 public:
  explicit WaySearch(WayGrid& grid) : grid_(grid), guide_(grid) {}

  void begin(const WayQuery& query);
  SearchState go_on(int64_t most);
  WayStats stats() const;
  std::size_t bytes() const { return guide_.bytes(); }
  // The way that was found, with start and goal.
  const std::vector<Vec3<double>>& points() const { return points_; }

 private:
  struct End {
    CellPlace place;
    float cost;  // from the start or to the goal
  };

  SearchState seed();
  std::vector<End> ends(const Vec3<double>& at);
  bool needs_page(const Vec3i& cell);
  SearchState expand(uint32_t cell, float value);
  // Clearances of the cells around one; whether none of them is on a page that is not there.
  bool look_around(CellPlace p, float* clearance, CellPlace* places);
  void reach(CellPlace p, const Vec3i& cell, float value, uint8_t step);
  float estimate(CellPlace p);
  void better();
  void finish();
  uint32_t number(CellPlace p) const {
    return static_cast<uint32_t>(p.row) * static_cast<uint32_t>(grid_.cells) + static_cast<uint32_t>(p.index);
  }
  CellPlace place(uint32_t cell) const {
    const uint32_t cells = static_cast<uint32_t>(grid_.cells);
    return {static_cast<int32_t>(cell / cells), static_cast<int32_t>(cell % cells)};
  }

  WayGrid& grid_;
  WayGuide guide_;
  WayQuery query_{};
  WayCost cost_{};
  Vec3<double> start_{}, goal_{};
  Vec3<float> near_goal_{};  // rounded
  SearchState state_ = kNoWay;
  bool seeded_ = false, is_found_ = false;
  int64_t most_ = 0, guided_ = 0;  // cells that are looked at at most, and were when the guide began
  CostQueue queue_;
  std::priority_queue<std::pair<float, uint32_t>> widest_;
  std::vector<End> goals_;
  float best_ = 0;  // cost of the best way to the goal so far
  CellPlace last_{-1, 0};
  int64_t expanded_ = 0;
  float nearest_ = 0;
  CellPlace nearest_cell_{-1, 0};
  BlockCoordinates wanted_{0, 0, 0};
  std::vector<Vec3<double>> points_;
};

}  // namespace ggslam::driving
