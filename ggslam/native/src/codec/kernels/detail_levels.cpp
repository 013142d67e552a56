// SPDX-License-Identifier: Apache-2.0
#include "codec/kernels/detail_levels.hpp"

namespace ggslam::GGSLAM_ISA::codec {

namespace {

// Offsets of the cubes around one, in the order in which they are searched. Of equally near points the first counts.
constexpr std::int8_t kAround[27][3] = {
    {0, 0, 0},  {-1, 0, 0}, {0, -1, 0},  {0, 0, -1},  {1, 0, 0},   {0, 1, 0},   {0, 0, 1},  {0, 1, 1},   {1, 0, 1},
    {1, 1, 0},  {0, -1, 1}, {-1, 0, 1},  {-1, 1, 0},  {0, 1, -1},  {1, 0, -1},  {1, -1, 0}, {0, -1, -1}, {-1, 0, -1},
    {-1, -1, 0}, {1, 1, 1}, {-1, 1, 1},  {1, -1, 1},  {1, 1, -1},  {1, -1, -1}, {-1, 1, -1}, {-1, -1, 1}, {-1, -1, -1}};


// The cube at an offset from another; false outside the grid.
bool neighbour_cube(std::uint64_t cube, const std::int8_t* offset, std::uint64_t& out) {
  constexpr std::uint64_t kAxis = 0x1249249249249249ull;
  out = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const std::uint64_t mask = kAxis << (2 - axis), own = cube & mask;
    std::uint64_t moved = own;
    if (offset[axis] > 0) moved = ((own | ~mask) + 1) & mask;
    if (offset[axis] < 0) {
      if (own == 0) return false;
      moved = (own - 1) & mask;
    }
    out |= moved;
  }
  return true;
}

}  // namespace

bool DetailLevels::build() {
  const auto count = static_cast<std::uint32_t>(points_.size());
  biased_ = points_;
  for (DetailPoint& p : biased_)
    for (int k = 0; k < 3; ++k) p[k] *= s_.bias[k];
  predictors.assign(count, Predictor{});
  order.reserve(count);
  std::vector<std::uint32_t> input(count), left, place(count);
  for (std::uint32_t i = 0; i < count; ++i) input[i] = i;
  level_sizes.assign(1, count);
  const std::uint64_t allowed = (std::uint64_t{1} << 28) + std::uint64_t{4096} * count;
  for (int level = 0; !input.empty() && level < s_.levels; ++level) {
    const std::size_t begin = order.size();
    if (level == s_.levels - 1)
      order.insert(order.end(), input.begin(), input.end());
    else
      thin_out(level, input, left);
    find_neighbours(level, begin, left);
    if (steps_ > allowed) return false;
    if (!left.empty()) level_sizes.push_back(static_cast<std::uint32_t>(left.size()));
    input.swap(left);
    left.clear();
  }
  for (std::uint32_t i = 0; i < count; ++i) place[order[i]] = i;
  for (Predictor& p : predictors) {
    for (int i = 0; i < p.count; ++i) p.neighbour[i] = place[p.neighbour[i]];
    p.weigh();
  }
  std::reverse(level_sizes.begin(), level_sizes.end());
  return true;
}

void DetailLevels::thin_out(int level, const std::vector<std::uint32_t>& input, std::vector<std::uint32_t>& left) {
  if (s_.decimation == 1) {
    for (std::size_t i = 0; i < input.size(); ++i)
      (i % static_cast<std::size_t>(s_.periods[level]) == 0 ? left : order).push_back(input[i]);
  } else if (input.size() == 1) {
    order.push_back(input[0]);
  } else if (s_.decimation == 2) {
    thin_out_by_cubes(level, input, left);
  } else {
    thin_out_by_distance(level, input, left);
  }
}

// A point stays if none that stays lies near it, among those in the cubes around.
void DetailLevels::thin_out_by_distance(int level, const std::vector<std::uint32_t>& input,
                                        std::vector<std::uint32_t>& left) {
  // Cubes whose points may come before the point's own, in the order of the search.
  static constexpr int kBefore[20] = {0, 1, 2, 3, 10, 11, 12, 13, 14, 15, 16, 17, 18, 20, 21, 22, 23, 24, 25, 26};
  const int distance = s_.first_distance + level, shift = 3 * (distance + 1);
  const int window_shift = std::min(63, shift + kCubeBits);
  const std::int64_t radius = distance < 30 ? std::int64_t{3} << (2 * distance) : Nearest::kFar;
  std::uint64_t window = ~std::uint64_t{0}, last = 0;
  std::size_t window_begin = 0;
  for (const std::uint32_t point : input) {
    const std::uint64_t cube = shifted_code(point, shift), own_window = codes_[point] >> window_shift;
    if (window != own_window) window = own_window, window_begin = left.size();
    bool near = !left.empty() && last == cube;
    for (int n = 0; n < 20 && !near && !left.empty(); ++n) {
      std::uint64_t other;
      if (!neighbour_cube(cube, kAround[kBefore[n]], other) || other >> kCubeBits != window) continue;
      auto it = std::lower_bound(left.begin() + static_cast<std::ptrdiff_t>(window_begin), left.end(), other,
                                 [&](std::uint32_t p, std::uint64_t c) { return shifted_code(p, shift) < c; });
      for (; it != left.end() && shifted_code(*it, shift) == other && !near; ++it, ++steps_)
        near = distance2(points_[*it], points_[point]) <= radius;
    }
    if (near) {
      order.push_back(point);
    } else {
      left.push_back(point);
      last = cube;
    }
  }
}

// Of the points in a cube (of several, until there are enough) the one nearest to their middle stays.
void DetailLevels::thin_out_by_cubes(int level, const std::vector<std::uint32_t>& input,
                                     std::vector<std::uint32_t>& left) {
  const int size = s_.first_distance + level, shift = 3 * (size + 1);
  std::vector<std::uint32_t> voxels;
  for (std::size_t i = 0; i < input.size(); ++i) {
    const bool last = i + 1 == input.size();
    voxels.push_back(input[i]);
    if (!last && shifted_code(input[i], shift) >= shifted_code(input[i + 1], shift)) continue;
    if (!last && voxels.size() < static_cast<std::size_t>(s_.periods[level])) continue;
    const std::uint32_t chosen = middle_of(voxels, size);
    for (const std::uint32_t point : voxels) (point == chosen ? left : order).push_back(point);
    voxels.clear();
  }
}

std::uint32_t DetailLevels::middle_of(const std::vector<std::uint32_t>& voxels, int size) const {
  const std::int32_t mask = static_cast<std::int32_t>(~std::uint32_t{0} << std::min(size, 31));
  const auto count = static_cast<std::int64_t>(voxels.size());
  std::int64_t sum[3] = {};
  for (const std::uint32_t point : voxels)
    for (int k = 0; k < 3; ++k) sum[k] += points_[point][k] & mask;
  std::int64_t least = Nearest::kFar;
  std::uint32_t chosen = voxels.back();
  for (auto it = voxels.rbegin(); it != voxels.rend(); ++it) {
    std::int64_t d = 0;
    for (int k = 0; k < 3; ++k) d += std::abs((points_[*it][k] & mask) * count - sum[k]);
    if (d < least) least = d, chosen = *it;
  }
  return chosen;
}

void DetailLevels::find_neighbours(int level, std::size_t begin, const std::vector<std::uint32_t>& left) {
  const std::size_t end = order.size();
  const int shift = 3 * (1 + s_.first_distance + level), window_shift = std::min(63, shift + kCubeBits);
  const bool within = level >= s_.skip_layers;
  left_boxes_.build(static_cast<std::int32_t>(left.size()), [&](std::int32_t i) { return biased_[left[i]]; });
  if (within)
    level_boxes_.build(static_cast<std::int32_t>(end - begin), [&](std::int32_t i) { return biased_[order[begin + i]]; });
  window_ = Window{};
  have_cube_ = false;
  std::int32_t at = 0;
  for (std::size_t i = begin; i < end; ++i) {
    const std::uint32_t point = order[i];
    Nearest nearest;
    if (!left.empty()) {
      search_left(left, at, point, shift, window_shift, nearest);
      for (std::int32_t& index : nearest.index)
        if (index != -1) index = static_cast<std::int32_t>(left[index]);
    }
    if (within) search_level(begin, i, point, nearest);
    Predictor& predictor = predictors[i];
    predictor.count = std::min(s_.neighbours, nearest.count());
    for (int k = 0; k < predictor.count; ++k) {
      predictor.neighbour[k] = static_cast<std::uint32_t>(nearest.index[k]);
      predictor.weight[k] = static_cast<std::uint64_t>(distance2(biased_[nearest.index[k]], biased_[point]));
    }
    predictor.order_by_distance();
  }
}

// The points that are left in the window of a code. A window that no point of this level lies in is never passed.
void DetailLevels::enter_window(const std::vector<std::uint32_t>& left, std::uint64_t code, int window_shift) {
  const auto id = static_cast<std::int64_t>(code >> window_shift);
  if (window_.id == id) return;
  window_.id = id;
  window_.begin = window_.end;
  while (window_.end < static_cast<std::int32_t>(left.size()) &&
         static_cast<std::int64_t>(codes_[left[window_.end]] >> window_shift) == id)
    ++window_.end;
}

void DetailLevels::collect_around(const std::vector<std::uint32_t>& left, std::uint64_t cube, int shift) {
  around_.clear();
  for (const auto& offset : kAround) {
    std::uint64_t other;
    if (!neighbour_cube(cube, offset, other) || static_cast<std::int64_t>(other >> kCubeBits) != window_.id) continue;
    auto it = std::lower_bound(left.begin() + window_.begin, left.begin() + window_.end, other,
                               [&](std::uint32_t p, std::uint64_t c) { return shifted_code(p, shift) < c; });
    for (; it != left.begin() + window_.end && shifted_code(*it, shift) == other; ++it)
      around_.push_back(static_cast<std::int32_t>(it - left.begin()));
  }
}

void DetailLevels::search_left(const std::vector<std::uint32_t>& left, std::int32_t& at, std::uint32_t point, int shift,
                               int window_shift, Nearest& nearest) {
  const auto last = static_cast<std::int32_t>(left.size()) - 1;
  const DetailPoint& from = biased_[point];
  while (at < last && codes_[point] >= codes_[left[at]]) ++at;
  enter_window(left, codes_[point], window_shift);
  const std::uint64_t cube = shifted_code(point, shift);
  if (!have_cube_ || cube != last_cube_) {
    have_cube_ = true;
    last_cube_ = cube;
    collect_around(left, cube, shift);
  }
  for (const std::int32_t k : around_) nearest.add(k, distance1(from, biased_[left[k]]));
  steps_ += around_.size() + 1;
  if (nearest.full()) return;
  const std::int32_t centre = nearest.index[0] == -1 ? at : nearest.index[0];
  const auto reach = static_cast<std::int64_t>(s_.search_between);
  const auto low = static_cast<std::int32_t>(std::max<std::int64_t>(0, centre - reach));
  const auto high = static_cast<std::int32_t>(std::min<std::int64_t>(last, centre + reach));
  const auto visit = [&](std::int32_t k) {
    ++steps_;
    nearest.add_new(k, distance1(from, biased_[left[k]]));
  };
  const auto skip = [&](std::int64_t d) {
    ++steps_;
    return nearest.full() && d >= nearest.distance[2];
  };
  visit(centre);
  for (int n = 1; n <= kNear; ++n) {
    if (centre + n <= high) visit(centre + n);
    if (centre - n >= low) visit(centre - n);
  }
  left_boxes_.scan(std::min(last, centre + kNear + 1), high, 1, from, skip, visit);
  left_boxes_.scan(std::max(0, centre - kNear - 1), low, -1, from, skip, visit);
}

// The points of the same level before this one.
void DetailLevels::search_level(std::size_t begin, std::size_t at, std::uint32_t point, Nearest& nearest) {
  const DetailPoint& from = biased_[point];
  const auto own = static_cast<std::int32_t>(at - begin), near = std::max(0, own - 1 - kNear);
  const auto visit = [&](std::int32_t h) {
    ++steps_;
    const std::uint32_t other = order[begin + h];
    nearest.add(static_cast<std::int32_t>(other), distance1(from, biased_[other]));
  };
  const auto skip = [&](std::int64_t d) {
    ++steps_;
    return nearest.full() && d >= nearest.distance[2];
  };
  for (std::int32_t h = own - 1; h >= near; --h) visit(h);
  const std::int64_t far = near - 1;
  if (far < 0) return;
  level_boxes_.scan(static_cast<std::int32_t>(far), static_cast<std::int32_t>(std::max<std::int64_t>(0, far - s_.search_within)),
                    -1, from, skip, visit);
}

}  // namespace ggslam::GGSLAM_ISA::codec
