// SPDX-License-Identifier: Apache-2.0
// Which blocks of the distance field an update computes.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <numeric>

#include "volumes/esdf.hpp"

namespace ggslam::volumes {
namespace {

using Clock = std::chrono::steady_clock;

// How far around a block that was never computed, and whose neighbours neither, sites are looked for first, voxels.
constexpr float kFirstPad = 24;

double milliseconds(Clock::time_point since) {
  return std::chrono::duration<double, std::milli>(Clock::now() - since).count();
}

// Squared gap between a block and the nearest of `sources`, in voxels; of blocks up to `window` away, in `range`.
class BlockGaps {
 public:
  // `range` encloses the sources.
  BlockGaps(const std::vector<BlockCoordinates>& sources, const Box3i& range, int window)
      : window_(window), range_(range), size_(cast<std::size_t>(range.high - range.low)),
        gap_(size_[0] * size_[1] * size_[2], kFar) {
    for (const BlockCoordinates& at : sources) gap_[index(at)] = 0;
  }

  void spread(ThreadPool& pool) {
    const std::size_t strides[3] = {1, size_[0], size_[0] * size_[1]};
    for (int a = 0; a < 3; ++a) {
      const int b = a == 0 ? 1 : 0, c = a == 2 ? 1 : 2;
      pool.parallel_for(size_[c], 1, [&](std::size_t begin, std::size_t end, int) {
        std::vector<int> line(size_[a]);
        for (std::size_t k = begin; k < end; ++k)
          for (std::size_t j = 0; j < size_[b]; ++j) spread_line(&gap_[k * strides[c] + j * strides[b]], strides[a], line);
      });
    }
  }

  int gap(BlockCoordinates at) const {
    return range_.contains(box_of(at)) ? gap_[index(at)] : kFar;
  }

 private:
  static constexpr int kFar = 1 << 29;
  const int window_;
  const Box3i range_;
  const Vec3<std::size_t> size_;
  std::vector<int> gap_;

  std::size_t index(BlockCoordinates at) const {
    const Vec3i p = vector_of(at) - range_.low;
    return p[0] + size_[0] * (p[1] + size_[1] * p[2]);
  }

  void spread_line(int* values, std::size_t stride, std::vector<int>& line) const {
    const int n = static_cast<int>(line.size());
    std::fill(line.begin(), line.end(), kFar);
    for (int i = 0; i < n; ++i) {
      const int height = values[i * stride];
      if (height == kFar) continue;
      for (int p = std::max(0, i - window_); p < std::min(n, i + window_ + 1); ++p) {
        const int steps = std::abs(p - i), gap = steps == 0 ? 0 : kSide * (steps - 1) + 1;
        line[p] = std::min(line[p], height + gap * gap);
      }
    }
    for (int i = 0; i < n; ++i) values[i * stride] = line[i];
  }
};

// Calls found(row, gap) for blocks with the gap to the nearest of `sources`, if that is up to `window` blocks away. Where
// the blocks lie far apart they are halved until what lies around each part fits the memory that is meant for it: the
// space between them costs nothing. Gaps do not depend on the parts.
class GapSearch {
 public:
  GapSearch(ThreadPool& pool, const BlockTable& table, int window) : pool_(pool), table_(table), window_(window) {}

  template <class Found>
  void search(std::vector<int32_t> rows, const std::vector<BlockCoordinates>& sources, const Found& found) const {
    Box3i box = Box3i::empty();
    for (const int32_t row : rows) box.include(box_of(table_.at(row)));
    const Box3i around = box.is_empty() ? box : box.grow(window_);
    std::vector<BlockCoordinates> near;
    Box3i range = Box3i::empty();
    for (const BlockCoordinates& at : sources)
      if (around.contains(box_of(at))) near.push_back(at), range.include(box_of(at).grow(window_));
    if (near.empty()) return;
    range = intersection(range, around);
    const int axis = longest_axis(box);
    if (1.0 * range.size(0) * range.size(1) * range.size(2) > kMostBlocks && box.size(axis) > 1) {
      const int middle = box.low[axis] + static_cast<int>(box.size(axis) / 2);
      const auto upper = std::partition(
          rows.begin(), rows.end(), [&](int32_t row) { return vector_of(table_.at(row))[axis] < middle; });
      search({rows.begin(), upper}, near, found);
      search({upper, rows.end()}, near, found);
      return;
    }
    BlockGaps gaps(near, range, window_);
    gaps.spread(pool_);
    for (const int32_t row : rows) found(row, gaps.gap(table_.at(row)));
  }

 private:
  static constexpr double kMostBlocks = 1 << 25;
  ThreadPool& pool_;
  const BlockTable& table_;
  const int window_;

  static int longest_axis(const Box3i& box) {
    const int a = box.size(1) > box.size(0) ? 1 : 0;
    return box.size(2) > box.size(a) ? 2 : a;
  }
};

}  // namespace

float Esdf::first_pad(int32_t row) const {
  const float most = max_distance_ + kCentreSlack + kReading;
  if (blocks_[row].required > 0) return std::min(blocks_[row].required, most);
  const BlockCoordinates at = table_.at(row);
  float pad = 0;
  for (int face = 0; face < 6; ++face) {
    BlockCoordinates next = at;
    (face / 2 == 0 ? next.x : face / 2 == 1 ? next.y : next.z) += face % 2 ? 1 : -1;
    const int32_t other = table_.find(next);
    if (other >= 0) pad = std::max(pad, blocks_[other].required);
  }
  return std::min(pad > 0 ? pad + kSide : kFirstPad, most);
}

// Those whose known voxels changed, and those that changed sites may be near enough to: a result depends on the sites
// not farther than its nearest one and kReading more, `required` at most. That holds whether sites come, go or move: one that goes was at
// the nearest one's distance, not nearer.
std::vector<Task> Esdf::affected(Context& context, const std::vector<int32_t>& changed) const {
  std::vector<uint8_t> listed(blocks_.size(), 0);
  std::vector<Task> tasks;
  for (int32_t row : changed) listed[row] = 1;
  if (!site_changes_.empty()) {
    const int window = static_cast<int>((max_distance_ + kCentreSlack + kReading) / kSide) + 1;
    std::vector<int32_t> rows(blocks_.size());
    std::iota(rows.begin(), rows.end(), 0);
    GapSearch(context.pool, table_, window).search(std::move(rows), site_changes_, [&](int32_t row, int gap) {
      const float reading = blocks_[row].required;
      if (static_cast<float>(gap) <= reading * reading) listed[row] = 1;
    });
  }
  for (std::size_t row = 0; row < blocks_.size(); ++row)
    if (listed[row]) tasks.push_back({static_cast<int32_t>(row), first_pad(static_cast<int32_t>(row))});
  return tasks;
}

void Esdf::compute(Context& context, std::vector<Task> tasks, FieldStats& stats) {
  bounds_ = Box3i::empty();
  for (std::size_t row = 0; row < blocks_.size(); ++row)
    if (!blocks_[row].sites.empty()) bounds_.include(box_of(table_.at(row)));
  if (bounds_.is_empty()) bounds_ = Box3i{};
  std::vector<Task> again;
  while (!tasks.empty()) {
    again.clear();
    for (const TaskBox& box : split_into_boxes(tasks, table_, bounds_))
      solve(context, {tasks.begin() + box.begin, tasks.begin() + box.end}, box.box, stats, again);
    tasks.swap(again);
  }
}

FieldStats Esdf::update(Context& context) {
  FieldStats stats{};
  if (tsdf_.revision == revision_) {
    stats.blocks = static_cast<int64_t>(blocks_.size());
    return stats;
  }
  auto start = Clock::now();
  const std::vector<int32_t> changed = find_sites(context, stats);
  stats.sites_ms = milliseconds(start);
  start = Clock::now();
  std::vector<Task> tasks = affected(context, changed);
  stats.select_ms = milliseconds(start);
  stats.recomputed_blocks = static_cast<int64_t>(tasks.size());
  stats.blocks = static_cast<int64_t>(blocks_.size());
  start = Clock::now();
  compute(context, std::move(tasks), stats);
  stats.transform_ms = milliseconds(start);
  revision_ = tsdf_.revision;
  return stats;
}

void Esdf::clear() {
  table_.clear();
  blocks_.clear();
  revision_ = 0;
}

std::size_t Esdf::bytes() const {
  std::size_t total = table_.bytes() + blocks_.capacity() * sizeof(FieldBlock);
  for (const FieldBlock& block : blocks_)
    total += block.sites.capacity() * sizeof(Site) + (block.voxels ? sizeof(FieldVoxels) : 0);
  return total;
}

}  // namespace ggslam::volumes
