// SPDX-License-Identifier: Apache-2.0
#include "driving/way_grid.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "common/guard.hpp"

namespace ggslam::driving {
namespace {

constexpr float kNothing = std::numeric_limits<float>::quiet_NaN();
constexpr double kParts = 1 << 20;  // of a cell that places are told in, so that centres stay centres
constexpr std::size_t kMostCells = std::size_t{1} << 32;  // cells of a search have numbers of 32 bits

}  // namespace

WayGrid::WayGrid(int dimensions_, double cell_, int page_)
    : dimensions(dimensions_), cell(cell_), page(page_),
      bits{dimensions_ == 2 ? 5 : 3, dimensions_ == 2 ? 5 : 3, dimensions_ == 2 ? 0 : 3},
      cells(1 << (bits[0] + bits[1] + bits[2])) {
  for (int a = 0; a < 3; ++a) mask_[a] = (1 << bits[a]) - 1;
  for (int n = 0; n < kAround; ++n)
    offset_[n] = (n % 3 - 1) + (n / 3 % 3 - 1) * (1 << bits[0]) + (n / 9 - 1) * (1 << (bits[0] + bits[1]));
  neighbours_.resize(static_cast<std::size_t>(cells) * kAround);
  for (int i = 0; i < cells; ++i)
    for (int n = 0; n < kAround; ++n) {
      const int to[3] = {(i & mask_[0]) + n % 3 - 1, (i >> bits[0] & mask_[1]) + n / 3 % 3 - 1,
                         (i >> (bits[0] + bits[1])) + n / 9 - 1};
      int beyond = 0, power = 1, index = 0;
      for (int a = 0, shift = 0; a < 3; power *= 3, shift += bits[a++]) {
        beyond += power * ((to[a] >> bits[a]) + 1);
        index |= (to[a] & mask_[a]) << shift;
      }
      neighbours_[static_cast<std::size_t>(i * kAround + n)] = static_cast<uint16_t>(beyond << kIndexBits | index);
    }
  inner_.assign(static_cast<std::size_t>(cells), 1);
  for (int i = 0; i < cells; ++i) {
    const int at[3] = {i & mask_[0], i >> bits[0] & mask_[1], i >> (bits[0] + bits[1])};
    for (int a = 0; a < dimensions; ++a)
      if (at[a] == 0 || at[a] == mask_[a]) inner_[static_cast<std::size_t>(i)] = 0;
  }
}

BlockCoordinates WayGrid::page_of(BlockCoordinates at) const {
  const auto down = [this](int32_t b) { return b >= 0 ? b / page : -((page - 1 - b) / page); };
  return {down(at.x), down(at.y), dimensions == 2 ? 0 : down(at.z)};
}

int32_t WayGrid::make(BlockCoordinates at) {
  const int32_t found = table_.find(at);
  if (found >= 0) return found;
  if ((blocks_.size() + 1) * static_cast<std::size_t>(cells) >= kMostCells) refuse("grid: too many cells");
  const int32_t row = static_cast<int32_t>(table_.insert(at));
  blocks_.emplace_back();
  if (!may_come(at)) ++layout_;
  WayBlock& made = blocks_.back();
  made.around[kHere] = row;
  made.clearance.reset(new float[static_cast<std::size_t>(cells)]);
  std::fill_n(made.clearance.get(), cells, kNothing);
  for (int n = 0; n < kAround; ++n) {
    const int x = n % 3 - 1, y = n / 3 % 3 - 1, z = n / 9 - 1;
    if (n == kHere) continue;
    const int32_t other = table_.find({at.x + x, at.y + y, at.z + z});
    made.around[n] = other;
    if (other >= 0) block(other).around[kAround - 1 - n] = row;
  }
  return row;
}

void WayGrid::write(const Vec3i& low, const Vec3i& shape, const float* clearance) {
  const float scale = static_cast<float>(1 / cell);
  for (int z = 0; z < shape[2]; ++z)
    for (int y = 0; y < shape[1]; ++y) {
      const float* line = clearance + (static_cast<std::size_t>(z) * shape[1] + y) * shape[0];
      for (int x = 0; x < shape[0];) {
        const Vec3i c{{low[0] + x, low[1] + y, low[2] + z}};
        const int run = std::min(shape[0] - x, (1 << bits[0]) - (c[0] & mask_[0]));
        const auto entered = [](float v) { return v == v; };
        int32_t row = table_.find(block_of(c));
        if (row < 0 && std::any_of(line + x, line + x + run, entered)) row = make(block_of(c));
        if (row >= 0) {
          ++block(row).version;
          float* to = block(row).clearance.get() + index_of(c);
          for (int i = 0; i < run; ++i) to[i] = line[x + i] * scale;
        }
        x += run;
      }
    }
}

void WayGrid::read(const Vec3i& low, const Vec3i& shape, float* clearance) const {
  CellReader reader(*this);
  for (int z = 0; z < shape[2]; ++z)
    for (int y = 0; y < shape[1]; ++y)
      for (int x = 0; x < shape[0]; ++x)
        *clearance++ = static_cast<float>(cell) * reader.clearance({{low[0] + x, low[1] + y, low[2] + z}});
}

std::size_t WayGrid::bytes() const {
  std::size_t sum = table_.bytes() + blocks_.capacity() * sizeof(WayBlock);
  for (const WayBlock& b : blocks_) sum += static_cast<std::size_t>(cells) * (4 + (b.nodes ? sizeof(WayNode) : 0) + (b.ahead ? 4 : 0) + (b.guide ? 4 : 0));
  return sum;
}

Vec3i WayGrid::cell_at(CellPlace p) const {
  const BlockCoordinates b = at(p.row);
  return {{(b.x << bits[0]) + (p.index & mask_[0]), (b.y << bits[1]) + ((p.index >> bits[0]) & mask_[1]),
           (b.z << bits[2]) + (p.index >> (bits[0] + bits[1]))}};
}

float WayGrid::clearance(const Vec3i& c) const {
  const CellPlace p = place(c);
  return p.row < 0 ? kNothing : block(p.row).clearance[static_cast<std::size_t>(p.index)];
}

void WayGrid::begin_search(bool same_goal) {
  ++search_;
  if (!same_goal || forgotten_) ++goal_, first_ = search_, costs_.clear();
  forgotten_ = false;
  costs_.push_back(-1);
}

void WayGrid::begin_block(WayBlock& b, float unreached) {
  const std::size_t n = static_cast<std::size_t>(cells);
  if (!b.nodes) b.nodes.reset(new WayNode[n]);
  else if (b.search >= first_) learn(b);
  std::fill_n(b.nodes.get(), n, WayNode{unreached, kNoStep, 0});
  b.search = search_;
}

// From the search that last came to a block, for the same goal.
void WayGrid::learn(WayBlock& b) {
  const float cost = costs_[b.search - first_];
  if (cost < 0) return;
  const std::size_t n = static_cast<std::size_t>(cells);
  if (!b.ahead) b.ahead.reset(new float[n]);
  if (b.goal != goal_) std::fill_n(b.ahead.get(), n, 0.0f);
  b.goal = goal_;
  for (std::size_t i = 0; i < n; ++i)
    if (b.nodes[i].done) b.ahead[i] = std::max(b.ahead[i], cost - b.nodes[i].value);
}

Vec3<double> WayGrid::to_cells(const double* metres) const {
  Vec3<double> out{{0, 0, 0}};
  for (int a = 0; a < dimensions; ++a) {
    out[a] = std::rint((metres[a] / cell - 0.5) * kParts) / kParts;
    if (!(std::fabs(out[a]) < static_cast<double>(kFarthestCell))) refuse("points: expected numbers near the grid's origin");
  }
  return out;
}

void WayGrid::to_metres(const Vec3<double>& cells_, double* metres) const {
  for (int a = 0; a < 3; ++a) metres[a] = a < dimensions ? (cells_[a] + 0.5) * cell : 0.0;
}

float CellReader::clearance(const Vec3i& c) {
  const BlockCoordinates wanted = grid_.block_of(c);
  if (!valid_ || wanted.x != at_.x || wanted.y != at_.y || wanted.z != at_.z) {
    const CellPlace p = grid_.place(c);
    values_ = p.row < 0 ? nullptr : grid_.block(p.row).clearance.get();
    at_ = wanted, valid_ = true;
  }
  return values_ == nullptr ? kNothing : values_[grid_.index_of(c)];
}

void CellReader::corners(const Vec3i& low, float* values) {
  const int count = 1 << grid_.dimensions;
  for (int i = 0; i < count; ++i) values[i] = clearance({{low[0] + (i & 1), low[1] + (i >> 1 & 1), low[2] + (i >> 2)}});
}

float CellReader::interpolate(const Vec3<double>& place, double* gradient) {
  const Vec3i low = floor(place);
  double t[3], sum = 0, slope[3] = {0, 0, 0};
  for (int a = 0; a < 3; ++a) t[a] = place[a] - low[a];
  const int count = 1 << grid_.dimensions;
  for (int i = 0; i < count; ++i) {
    double share[3];
    for (int a = 0; a < 3; ++a) share[a] = i >> a & 1 ? t[a] : 1 - t[a];
    if (share[0] * share[1] * share[2] == 0 && gradient == nullptr) continue;  // NaN beside a centre does no harm
    const double v = clearance({{low[0] + (i & 1), low[1] + (i >> 1 & 1), low[2] + (i >> 2)}});
    sum += share[0] * share[1] * share[2] * v;
    for (int a = 0; a < grid_.dimensions; ++a)
      slope[a] += (i >> a & 1 ? 1 : -1) * share[(a + 1) % 3] * share[(a + 2) % 3] * v;
  }
  if (gradient != nullptr) std::copy_n(slope, 3, gradient);
  return static_cast<float>(sum);
}

}  // namespace ggslam::driving
