// SPDX-License-Identifier: Apache-2.0
// Into which boxes the blocks to compute are put.
#include <algorithm>
#include <cmath>
#include <limits>

#include "volumes/esdf.hpp"

namespace ggslam::volumes {
namespace {

// Voxels in a box's largest array at most, unless it is a single block.
constexpr int64_t kMostVoxels = int64_t{1} << 25;
// Edge of a box at most, blocks: places in a padded box must fit SiteCell.
constexpr int64_t kLongest = 1024;

struct Splitter {
  std::vector<Task>& tasks;
  const BlockTable& table;
  const Box3i& bounds;
  std::vector<TaskBox> boxes;

  Box3i bound(std::size_t begin, std::size_t end, float& pad) const {
    Box3i box = Box3i::empty();
    pad = 0;
    for (std::size_t i = begin; i < end; ++i) {
      pad = std::max(pad, tasks[i].pad);
      box.include(box_of(table.at(tasks[i].row)));
    }
    return box;
  }

  // Voxels through each pass over a box, an estimate of its time; and the largest array.
  double cost(const Box3i& box, float pad, int64_t& largest) const {
    const Box3i p = padded_box(box, pad, bounds);
    const double x = kSide * static_cast<double>(box.size(0)), y = kSide * static_cast<double>(box.size(1)),
                 z = kSide * static_cast<double>(box.size(2));
    const double py = static_cast<double>(p.size(1)), pz = static_cast<double>(p.size(2));
    largest = static_cast<int64_t>(std::min(x * std::max(py, y) * std::max(pz, z), 1e18));
    return 0.3 * x * py * pz + x * (py + y) * pz + x * y * (pz + z) + 20000;
  }

  double cost_of(std::size_t begin, std::size_t end, int64_t& largest) const {
    float pad;
    const Box3i box = bound(begin, end, pad);
    return cost(box, pad, largest);
  }

  // Halves the tasks at the middle of the axis where that costs least, as long as it lowers the cost.
  void split(std::size_t begin, std::size_t end) {
    float pad;
    const Box3i box = bound(begin, end, pad);
    int64_t largest, unused;
    const double whole = cost(box, pad, largest);
    const bool too_large = largest > kMostVoxels || std::max({box.size(0), box.size(1), box.size(2)}) > kLongest;
    double best = too_large ? std::numeric_limits<double>::max() : whole;
    int axis = -1;
    const auto half = [&](int a) {
      const int middle = box.low[a] + static_cast<int>(box.size(a) / 2);
      return std::partition(tasks.begin() + begin, tasks.begin() + end,
                            [&](const Task& t) { return vector_of(table.at(t.row))[a] < middle; }) - tasks.begin();
    };
    for (int a = 0; a < 3; ++a) {
      if (box.size(a) < 2) continue;
      const std::size_t middle = half(a);
      const double both = cost_of(begin, middle, unused) + cost_of(middle, end, unused);
      if (both < best) best = both, axis = a;
    }
    if (axis < 0) {
      boxes.push_back({box, begin, end});
      return;
    }
    const std::size_t middle = half(axis);
    split(begin, middle);
    split(middle, end);
  }
};

}  // namespace

Box3i padded_box(const Box3i& box, float pad, const Box3i& bounds) {
  const Box3i p = intersection(box.scale(kSide).grow(static_cast<int>(std::ceil(pad))), bounds.scale(kSide));
  return {p.low, max(p.low, p.high)};
}

std::vector<TaskBox> split_into_boxes(std::vector<Task>& tasks, const BlockTable& table, const Box3i& bounds) {
  Splitter splitter{tasks, table, bounds, {}};
  if (!tasks.empty()) splitter.split(0, tasks.size());
  return std::move(splitter.boxes);
}

}  // namespace ggslam::volumes
