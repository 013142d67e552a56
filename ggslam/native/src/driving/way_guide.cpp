// SPDX-License-Identifier: Apache-2.0
#include "driving/way_guide.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "common/dispatch.hpp"

GGSLAM_DECLARE_KERNEL(void ways_over_places(const float* x, const float* y, const float* z, int count,
                                            const float* places, int number, float* left))

namespace ggslam::driving {
namespace {

constexpr float kFar = std::numeric_limits<float>::infinity();
constexpr int64_t kBetterBound = 512;  // patches, after which what is left at least is told anew

// The places of a patch's cells.
struct Cells {
  float x[kPatchCells], y[kPatchCells], z[kPatchCells];

  Cells(const WayPatches& patches, int64_t patch) {
    const Vec3<float> low = cast<float>(patches.low(patch));
    for (int i = 0; i < kPatchCells; ++i) {
      const Vec3<float> at = low + cast<float>(patches.cell(i));
      x[i] = at[0], y[i] = at[1], z[i] = at[2];
    }
  }
};

}  // namespace

void WayGuide::begin(const WayCost& cost, const Vec3<float>& start, const Vec3<float>& goal) {
  cost_ = cost, start_ = start, goal_ = goal;
  goals_.clear();
  begin_again();
}

void WayGuide::begin_again() {
  patches_.begin(cost_);
  queue_.clear(), goal_patches_.clear(), expanded_ = 0;
  ++version_, ++bound_version_;
  for (const Vec3i& cell : std::vector<Vec3i>(std::move(goals_))) add_goal(cell);
}

void WayGuide::add_goal(const Vec3i& cell) {
  goals_.push_back(cell);
  const int64_t patch = patches_.number(cell);
  if (patch < 0 || std::count(goal_patches_.begin(), goal_patches_.end(), patch) > 0) return;
  goal_patches_.push_back(patch);
  reach(patch, steps_between(goal_, patches_.patch(patch).middle));
}

WayGuide::Node& WayGuide::node(int64_t patch) {
  if (nodes_.size() < patches_.size()) nodes_.resize(patches_.size(), {kFar, 0, false});
  Node& found = nodes_[static_cast<std::size_t>(patch)];
  if (found.search != version_) found = {kFar, version_, false};
  return found;
}

void WayGuide::reach(int64_t patch, float value) {
  node(patch) = {value, version_, false};
  queue_.push(value + steps_between(patches_.patch(patch).middle, start_), {static_cast<uint32_t>(patch), value});
}

// Looks at the patch that the way over costs least.
void WayGuide::step() {
  CostQueue::Entry entry{0, 0};
  if (!queue_.pop(&entry)) return;
  Node& here = node(entry.cell);
  if (here.done || entry.value > here.value) return;
  here.done = true, ++expanded_;
  if (expanded_ % kBetterBound == 0) ++bound_version_;
  patches_.around(entry.cell, &around_);
  const Vec3<float> middle = patches_.patch(entry.cell).middle;
  const float factor = patches_.patch(entry.cell).factor;
  for (const int64_t n : around_) {
    if (node(n).done) continue;
    const Patch& there = patches_.patch(n);
    const float value = entry.value + steps_between(middle, there.middle) * 0.5f * (factor + there.factor);
    if (value < node(n).value) reach(n, value);
  }
}

void WayGuide::fill(CellPlace p, int index, int64_t most) {
  WayBlock& b = grid_.block(p.row);
  if (!b.guide) b.guide.reset(new float[static_cast<std::size_t>(grid_.cells)]());
  bool is_known = true;
  patches_.for_each(grid_.at(p.row), index, [&](int64_t n) {
    float left[kPatchCells];
    is_known &= fill(n, most, left);
    const Vec3i low = patches_.low(n);
    for (uint64_t open = patches_.patch(n).open; open != 0; open &= open - 1) {
      const int i = __builtin_ctzll(open);
      b.guide[static_cast<std::size_t>(grid_.index_of(low + patches_.cell(i)))] = left[i];
    }
  });
  b.guided[index] = is_known ? version_ : bound_version_;
}

// What is left from the cells of a patch; whether that is known, and not only a bound of it.
bool WayGuide::fill(int64_t patch, int64_t most, float* left) {
  while (!node(patch).done && !queue_.is_empty() && expanded_ < most) step();
  std::fill_n(left, kPatchCells, kFar);
  if (!node(patch).done && queue_.is_empty()) return true;
  const Cells cells(patches_, patch);
  if (!node(patch).done) {  // it is farther than all that was looked at
    for (int i = 0; i < kPatchCells; ++i)
      left[i] = std::max(0.0f, queue_.rank() - steps_between({{cells.x[i], cells.y[i], cells.z[i]}}, start_));
    return false;
  }
  const float factor = patches_.patch(patch).factor, value = node(patch).value;
  places_.clear();
  const auto add = [&](const Vec3<float>& at, float value_there, float factor_there) {
    places_.insert(places_.end(), {at[0], at[1], at[2], value_there, factor_there});
  };
  patches_.around(patch, &around_);
  for (const int64_t n : around_) {
    if (!(node(n).value <= value)) continue;
    add(patches_.patch(n).middle, node(n).value, 0.5f * (factor + patches_.patch(n).factor));
    if (std::count(goal_patches_.begin(), goal_patches_.end(), n) > 0) add(goal_, 0, factor);
  }
  static const auto over = GGSLAM_DISPATCH(best_isa(), ways_over_places);
  over(cells.x, cells.y, cells.z, kPatchCells, places_.data(), static_cast<int>(places_.size() / 5), left);
  return true;
}

}  // namespace ggslam::driving
