// SPDX-License-Identifier: Apache-2.0
#include "driving/way_search.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "driving/clear_line.hpp"

namespace ggslam::driving {
namespace {

constexpr float kFar = std::numeric_limits<float>::infinity();
// A search goes for the goal first, and betters what it found as long as that is not much work.
struct Haste {
  float greed, spared;  // what is told to be left counts times this, but for so many cells
};
constexpr Haste kFirst{1.08f, 2}, kThen{1, 4};  // the guide tells up to 4 cells too much
constexpr int64_t kMostBettering = 6000;        // cells
// Patches that the guide looks at before it is no more work than the search; of what is not read there is no end.
constexpr int64_t kPatches = 32768, kPatchesOfPages = 4096;
constexpr float kWorthwhile = 0.005f;  // part of a step's length that a way has to be cheaper by to be taken instead

// The 26 cells around one, of which a grid of two dimensions has the 8 in the middle.
struct Steps {
  float length[kAround];
  uint32_t through[kAround];  // cells that have to be passable for a step: those that it passes between, and its end
  Steps() {
    for (int n = 0; n < kAround; ++n) {
      const int x = n % 3 - 1, y = n / 3 % 3 - 1, z = n / 9 - 1;
      length[n] = std::sqrt(static_cast<float>(x * x + y * y + z * z));
      through[n] = 0;
      for (int c = 1; c < 8; ++c)
        through[n] |= 1u << (kHere + (c & 1 ? x : 0) + (c & 2 ? 3 * y : 0) + (c & 4 ? 9 * z : 0));
      through[n] &= ~(1u << kHere);
    }
  }
};

const Steps& steps() {
  static const Steps all;
  return all;
}

}  // namespace

void WaySearch::begin(const WayQuery& query) {
  const auto same_place = [](const double* a, const double* b) { return std::equal(a, a + 3, b); };
  const bool same_cost =
      query.radius == query_.radius && query.margin == query_.margin && query.weight == query_.weight;
  const bool same_goal = same_place(query.goal, query_.goal) && same_cost && !query.widest && !query_.widest;
  query_ = query;
  const float scale = static_cast<float>(1 / grid_.cell);
  cost_ = {query.radius * scale, query.margin * scale, query.weight};
  start_ = grid_.to_cells(query.start), goal_ = grid_.to_cells(query.goal);
  near_goal_ = cast<float>(goal_);
  queue_.clear(), widest_ = {}, goals_.clear(), points_.clear();
  grid_.begin_search(same_goal);
  seeded_ = is_found_ = false, state_ = kSearching, best_ = query.widest ? -1 : kFar;
  expanded_ = guided_ = 0, most_ = std::numeric_limits<int64_t>::max();
  last_ = nearest_cell_ = {-1, 0}, nearest_ = kFar;
}

float WaySearch::estimate(CellPlace p) {
  const Haste& haste = is_found_ ? kThen : kFirst;
  const float straight = steps_between(cast<float>(grid_.cell_at(p)), near_goal_);
  const int64_t most = (grid_.page == 0 ? kPatches : kPatchesOfPages) + expanded_ - guided_;
  const float guided = haste.greed * (guide_.left(p, most) - haste.spared);
  return std::max(std::max(straight, guided), grid_.ahead(p));
}

// Ranks what is left of a search that found a way by what may better it.
void WaySearch::better() {
  is_found_ = true, most_ = expanded_ + kMostBettering;
  queue_.sort([this](const CostQueue::Entry& entry) {
    if (entry.value > grid_.node(place(entry.cell), kFar).value) return kFar;
    const float whole = entry.value + estimate(place(entry.cell));
    return whole < best_ ? whole : kFar;
  });
}

bool WaySearch::needs_page(const Vec3i& cell) {
  const BlockCoordinates at = grid_.block_of(cell);
  if (!grid_.may_come(at)) return false;
  wanted_ = grid_.page_of(at);
  return true;
}

// Cells around a place that can be reached from it, and what that costs.
std::vector<WaySearch::End> WaySearch::ends(const Vec3<double>& at) {
  CellReader reader(grid_);
  std::vector<End> found;
  const Vec3i low = floor(at);
  for (int i = 0; i < 1 << grid_.dimensions; ++i) {
    const Vec3i c{{low[0] + (i & 1), low[1] + (i >> 1 & 1), low[2] + (i >> 2)}};
    const Vec3<double> centre = cast<double>(c);
    const CellPlace p = grid_.place(c);
    double sum = 0;
    if (p.row < 0) continue;
    if (query_.widest) {
      const float least = least_clearance(reader, at, centre);
      if (least >= cost_.radius) found.push_back({p, least});
    } else if (is_clear(reader, at, centre, cost_, &sum)) {
      found.push_back({p, static_cast<float>(sum)});
    }
  }
  return found;
}

SearchState WaySearch::seed() {
  for (const Vec3<double>& at : {start_, goal_}) {
    const Vec3i low = floor(at);
    for (int i = 0; i < 1 << grid_.dimensions; ++i)
      if (needs_page({{low[0] + (i & 1), low[1] + (i >> 1 & 1), low[2] + (i >> 2)}})) return kNeedsPages;
  }
  seeded_ = true;
  goals_ = ends(goal_);
  if (goals_.empty()) return kNoWay;
  if (!query_.widest) {
    guide_.begin(cost_, cast<float>(start_), near_goal_);
    for (const End& end : goals_) guide_.add_goal(grid_.cell_at(end.place));
  }
  for (const End& end : ends(start_)) reach(end.place, grid_.cell_at(end.place), end.cost, kHere);
  return kSearching;
}

void WaySearch::reach(CellPlace p, const Vec3i& cell, float value, uint8_t step) {
  WayNode& node = grid_.node(p, query_.widest ? -1 : kFar);
  node.value = value, node.step = step;
  const float left = steps_between(cast<float>(cell), near_goal_);
  if (left < nearest_) nearest_ = left, nearest_cell_ = p;
  if (query_.widest) widest_.push({value, number(p)});
  else if (const float whole = value + estimate(p); whole < kFar) queue_.push(whole, {number(p), value});
}

bool WaySearch::look_around(CellPlace p, float* clearance, CellPlace* places) {
  const int first = grid_.dimensions == 2 ? 9 : 0, last = grid_.dimensions == 2 ? 18 : 27;
  if (grid_.is_inner(p)) {
    const float* own = grid_.block(p.row).clearance.get();
    for (int n = first; n < last; ++n) {
      places[n] = {p.row, p.index + grid_.offset(n)};
      clearance[n] = own[places[n].index];
    }
    return true;
  }
  for (int n = first; n < last; ++n) {
    places[n] = grid_.neighbour(p, n);
    if (places[n].row >= 0) {
      clearance[n] = grid_.block(places[n].row).clearance[static_cast<std::size_t>(places[n].index)];
      continue;
    }
    clearance[n] = std::numeric_limits<float>::quiet_NaN();
    if (grid_.page == 0) continue;
    const Vec3i c = grid_.cell_at(p);
    if (needs_page({{c[0] + n % 3 - 1, c[1] + n / 3 % 3 - 1, c[2] + n / 9 - 1}})) return false;
  }
  return true;
}

SearchState WaySearch::expand(uint32_t cell, float value) {
  const CellPlace here = place(cell);
  float clearance[kAround];
  CellPlace places[kAround];
  if (!look_around(here, clearance, places)) return kNeedsPages;
  ++expanded_;
  for (const End& goal : goals_) {
    if (goal.place.row != here.row || goal.place.index != here.index) continue;
    const float whole = query_.widest ? std::min(value, goal.cost) : value + goal.cost;
    if (query_.widest ? whole > best_ : whole < best_) best_ = whole, last_ = here;
  }
  const int first = grid_.dimensions == 2 ? 9 : 0, last = grid_.dimensions == 2 ? 18 : 27;
  uint32_t passable = 0;
  for (int n = first; n < last; ++n) passable |= static_cast<uint32_t>(clearance[n] >= cost_.radius) << n;
  const float own = cost_.factor(clearance[kHere]);
  const Vec3i c = grid_.cell_at(here);
  const Steps& all = steps();
  grid_.node(here, kFar).done = 1;
  for (int n = first; n < last; ++n) {
    if (n == kHere || (all.through[n] & ~passable) != 0) continue;
    const WayNode& there = grid_.node(places[n], query_.widest ? -1 : kFar);
    const uint8_t back = static_cast<uint8_t>(kAround - 1 - n);
    const Vec3i at{{c[0] + n % 3 - 1, c[1] + n / 3 % 3 - 1, c[2] + n / 9 - 1}};
    if (query_.widest) {
      float least = value;
      for (int m = first; m < last; ++m)
        if (all.through[n] >> m & 1) least = std::min(least, clearance[m]);
      if (least > there.value) reach(places[n], at, least, back);
      continue;
    }
    const float length = all.length[n], known = there.value - kWorthwhile * length;
    if (value + length >= known) continue;
    const float next = value + length * 0.5f * (own + cost_.factor(clearance[n]));
    if (next < known) reach(places[n], at, next, back);
  }
  return kSearching;
}

SearchState WaySearch::go_on(int64_t most) {
  if (state_ == kNeedsPages) {
    state_ = kSearching;
    // Pages that came show the guide more; it begins again when that is no more work than was done since.
    if (seeded_ && !query_.widest && expanded_ - guided_ >= guide_.expanded())
      guide_.begin_again(), guided_ = expanded_;
  }
  if (!seeded_ && state_ == kSearching) state_ = seed();
  for (int64_t i = 0; i < most && state_ == kSearching; ++i) {
    CostQueue::Entry entry{0, 0};
    if (query_.widest) {
      if (widest_.empty() || widest_.top().first <= best_) {
        finish();
        break;
      }
      entry = {widest_.top().second, widest_.top().first};
      widest_.pop();
    } else {
      if (queue_.rank() >= best_ && !is_found_) better();
      if (queue_.rank() >= best_ || expanded_ >= most_ || !queue_.pop(&entry)) {
        finish();
        break;
      }
    }
    const float known = grid_.node(place(entry.cell), query_.widest ? -1 : kFar).value;
    if (query_.widest ? entry.value < known : entry.value > known) continue;  // reached in a better way since
    if (!query_.widest && guide_.is_old(place(entry.cell))) {
      const float whole = entry.value + estimate(place(entry.cell));
      if (whole > queue_.rank() + 1) {  // it is worth less than was known when it was reached
        if (whole < kFar) queue_.push(whole, entry);
        continue;
      }
    }
    state_ = expand(entry.cell, entry.value);
    if (state_ != kNeedsPages) continue;
    if (query_.widest) widest_.push({entry.value, entry.cell});
    else queue_.push(entry.value + estimate(place(entry.cell)), entry);
  }
  return state_;
}

void WaySearch::finish() {
  state_ = last_.row < 0 ? kNoWay : kFound;
  if (!query_.widest) grid_.end_search(best_);
  if (state_ == kNoWay) return;
  points_.push_back(goal_);
  for (CellPlace p = last_;;) {
    points_.push_back(cast<double>(grid_.cell_at(p)));
    const uint8_t step = grid_.node(p, kFar).step;
    if (step == kHere || step == kNoStep) break;
    p = grid_.neighbour(p, step);
  }
  points_.push_back(start_);
  std::reverse(points_.begin(), points_.end());
}

WayStats WaySearch::stats() const {
  WayStats out{};
  out.expanded = expanded_, out.points = static_cast<int64_t>(points_.size());
  out.cost = last_.row < 0 ? -1 : best_ * grid_.cell;
  if (nearest_cell_.row >= 0) grid_.to_metres(cast<double>(grid_.cell_at(nearest_cell_)), out.reached);
  out.wanted[0] = wanted_.x, out.wanted[1] = wanted_.y, out.wanted[2] = wanted_.z;
  return out;
}

}  // namespace ggslam::driving
