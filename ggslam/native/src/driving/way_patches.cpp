// SPDX-License-Identifier: Apache-2.0
#include "driving/way_patches.hpp"

#include <algorithm>
#include <cmath>

#include "common/guard.hpp"

namespace ggslam::driving {
namespace {

constexpr int32_t kUnknown = -2;
constexpr uint32_t kToCome = 0, kNothing = ~0u - 1, kNever = ~0u;  // versions of what is not there
constexpr float kRounding = 1e-5f;  // cells; more than a line's clearance is off by, so that no way is missed
constexpr std::size_t kMostPatches = std::size_t{1} << 31;

int power3(int axis) { return axis == 0 ? 1 : axis == 1 ? 3 : 9; }

}  // namespace

WayPatches::WayPatches(const WayGrid& grid)
    : grid_(grid), side_bits_(grid.dimensions == 2 ? 3 : 2), per_side_bits_(grid.bits[0] - side_bits_),
      count_bits_(per_side_bits_ * grid.dimensions), count_(1 << count_bits_) {
  const int n = grid.dimensions, per_side = 1 << per_side_bits_;
  index_.resize(static_cast<std::size_t>(grid.cells));
  for (int i = 0; i < grid.cells; ++i) {
    int index = 0;
    for (int a = 0, shift = 0; a < n; shift += grid.bits[a++])
      index |= (i >> shift & ((1 << grid.bits[a]) - 1)) >> side_bits_ << (per_side_bits_ * a);
    index_[static_cast<std::size_t>(i)] = static_cast<uint8_t>(index);
  }
  beside_.resize(static_cast<std::size_t>(count_) * kAround);
  for (int i = 0; i < count_; ++i)
    for (int k = 0; k < kAround; ++k) {
      const int step[3] = {k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1};
      int beyond = kHere, index = 0;
      for (int a = 0; a < n; ++a) {
        const int to = (i >> (per_side_bits_ * a) & (per_side - 1)) + step[a];
        beyond += power3(a) * (to < 0 ? -1 : to >= per_side ? 1 : 0);
        index |= (to & (per_side - 1)) << (per_side_bits_ * a);
      }
      beside_[static_cast<std::size_t>(i * kAround + k)] = static_cast<uint16_t>(beyond << 8 | index);
    }
  for (int a = 0; a < 3; ++a) {
    face_[a] = 0, beyond_[a] = ((1 << side_bits_) - 1) << (side_bits_ * a);
    for (int i = 0; i < kPatchCells; ++i)
      if ((i >> (side_bits_ * a) & ((1 << side_bits_) - 1)) == 0) face_[a] |= uint64_t{1} << i;
  }
}

void WayPatches::begin(const WayCost& cost) {
  const bool same = cost.radius == cost_.radius && cost.margin == cost_.margin && cost.weight == cost_.weight;
  if (!same || layout_ != grid_.layout()) table_.clear(), rows_.clear(), blocks_.clear(), patches_.clear();
  cost_ = cost, layout_ = grid_.layout(), ++search_;
}

Vec3i WayPatches::low(int64_t number) const {
  const BlockCoordinates b = blocks_[static_cast<std::size_t>(number >> count_bits_)].at;
  const int index = static_cast<int>(number & (count_ - 1)), mask = (1 << per_side_bits_) - 1;
  Vec3i out{{b.x << grid_.bits[0], b.y << grid_.bits[1], b.z << grid_.bits[2]}};
  for (int a = 0; a < grid_.dimensions; ++a) out[a] += (index >> (per_side_bits_ * a) & mask) << side_bits_;
  return out;
}

int32_t WayPatches::add_block(BlockCoordinates at) {
  if (patches_.size() + static_cast<std::size_t>(count_) >= kMostPatches) refuse("grid: too many cells");
  const int32_t row = static_cast<int32_t>(blocks_.size());
  blocks_.push_back({at, search_ - 1, search_ - 1, kNever, -1, {}});
  for (int n = 0; n < kAround; ++n)
    blocks_.back().around[n] = grid_.dimensions == 2 && n / 9 != 1 ? -1 : kUnknown;
  patches_.resize(patches_.size() + static_cast<std::size_t>(count_), {0, {{0, 0, 0}}, 1});
  return row;
}

int32_t WayPatches::block(BlockCoordinates at) {
  const int32_t known = table_.find(at);
  int32_t row = known < 0 ? -1 : rows_[static_cast<std::size_t>(known)];
  if (row < 0) {
    if (grid_.row(at) < 0 && !grid_.may_come(at)) return -1;
    row = add_block(at);
    table_.insert(at), rows_.push_back(row);
  }
  if (blocks_[static_cast<std::size_t>(row)].seen != search_) look(row);
  return row;
}

// Takes over what a block of the grid is now.
void WayPatches::look(int32_t row) {
  Block& own = blocks_[static_cast<std::size_t>(row)];
  own.seen = search_;
  const int32_t there = grid_.row(own.at);
  const uint32_t missing = grid_.may_come(own.at) ? kToCome : kNothing;
  const uint32_t version = there < 0 ? missing : grid_.block(there).version;
  if (version == own.version) return;
  own.version = version;
  const float* clearance = there < 0 ? nullptr : grid_.block(there).clearance.get();
  for (int i = 0; i < count_; ++i) look(row, i, clearance, version == kToCome);
}

void WayPatches::look(int32_t row, int index, const float* clearance, bool may_come) {
  const Vec3i first = low(static_cast<int64_t>(row) * count_ + index);
  const int side = 1 << side_bits_, mask = side - 1;
  uint64_t open = may_come ? ~uint64_t{0} : 0;
  float best = may_come ? cost_.radius + cost_.margin : cost_.radius;
  for (int line = 0; line < kPatchCells / side && clearance != nullptr; ++line) {
    const Vec3i at{{first[0], first[1] + (line & mask), first[2] + (line >> side_bits_)}};
    const float* from = clearance + grid_.index_of(at);
    for (int x = 0; x < side; ++x) {
      open |= static_cast<uint64_t>(from[x] >= cost_.radius - kRounding) << (line * side + x);
      best = from[x] > best ? from[x] : best;
    }
  }
  for (int32_t to = row;;) {
    const uint64_t some = part(open);
    patches_[static_cast<std::size_t>(static_cast<int64_t>(to) * count_ + index)] = patch_of(first, some, best);
    open &= ~some;
    int32_t next = blocks_[static_cast<std::size_t>(to)].next;
    if (next < 0 && open == 0) break;
    if (next < 0) {
      next = add_block(blocks_[static_cast<std::size_t>(to)].at);
      blocks_[static_cast<std::size_t>(to)].next = next;
    }
    to = next;
  }
}

// Cells that are joined to the first of some.
uint64_t WayPatches::part(uint64_t open) const {
  if (open == 0 || open == ~uint64_t{0}) return open;
  uint64_t found = open & (~open + 1), before = 0;
  while (found != before) {
    before = found;
    for (int a = 0; a < grid_.dimensions; ++a) {
      const int step = 1 << (side_bits_ * a);
      found |= ((found & ~(face_[a] << beyond_[a])) << step | (found & ~face_[a]) >> step) & open;
    }
  }
  return found;
}

Patch WayPatches::patch_of(const Vec3i& low, uint64_t open, float best) const {
  if (open == 0) return {0, {{0, 0, 0}}, 1};
  Vec3<float> sum{{0, 0, 0}};
  const float n = static_cast<float>(__builtin_popcountll(open));
  for (int a = 0; a < grid_.dimensions; ++a)
    for (int k = 1; k < side(); ++k)  // layer by layer
      sum[a] += static_cast<float>(k * __builtin_popcountll(open >> (k << (side_bits_ * a)) & face_[a]));
  return {open, cast<float>(low) + (1 / n) * sum, cost_.factor(best)};
}

int64_t WayPatches::number(const Vec3i& cell) {
  const int index = index_of(grid_.index_of(cell)), mask = (1 << side_bits_) - 1;
  const int bit = (cell[0] & mask) | (cell[1] & mask) << side_bits_ | (cell[2] & mask) << (2 * side_bits_);
  int64_t found = -1;
  for_each(grid_.block_of(cell), index, [&](int64_t n) {
    if (patch(n).open >> bit & 1) found = n;
  });
  return found;
}

// Finds all blocks around one.
void WayPatches::look_around(int32_t row) {
  const BlockCoordinates at = blocks_[static_cast<std::size_t>(row)].at;
  for (int n = 0; n < kAround; ++n) {
    const int32_t known = blocks_[static_cast<std::size_t>(row)].around[n];
    if (known == -1 || (known >= 0 && blocks_[static_cast<std::size_t>(known)].seen == search_)) continue;
    const int32_t other = block({at.x + n % 3 - 1, at.y + n / 3 % 3 - 1, at.z + n / 9 - 1});
    blocks_[static_cast<std::size_t>(row)].around[n] = other;
  }
  blocks_[static_cast<std::size_t>(row)].looked = search_;
}

void WayPatches::around(int64_t number, std::vector<int64_t>* found) {
  // Faces first, then edges, then corners: each is reached over one that comes before it.
  static constexpr int kOrder[26] = {4,  10, 12, 14, 16, 22, 1,  3,  5,  7,  9,  11, 15,
                                     17, 19, 21, 23, 25, 0,  2,  6,  8,  18, 20, 24, 26};
  const std::size_t row = static_cast<std::size_t>(number >> count_bits_);
  if (blocks_[row].looked != search_) look_around(static_cast<int32_t>(row));
  const int32_t* rows = blocks_[row].around;
  const uint16_t* beside = beside_.data() + static_cast<std::size_t>(number & (count_ - 1)) * kAround;
  uint64_t open[kAround] = {};
  found->assign(1, number), open[kHere] = patch(number).open;
  for (const int n : kOrder) {
    const int32_t first = rows[beside[n] >> 8];
    if (first < 0) continue;
    const int step[3] = {n % 3 - 1, n / 3 % 3 - 1, n / 9 - 1};
    uint64_t from[3];
    bool any = false;
    for (int a = 0; a < 3; ++a) {
      from[a] = step[a] == 0 ? 0 : open[n - step[a] * power3(a)] & (step[a] > 0 ? face_[a] << beyond_[a] : face_[a]);
      any |= from[a] != 0;
    }
    if (!any) continue;
    for (int32_t to = first; to >= 0; to = blocks_[static_cast<std::size_t>(to)].next) {
      const int64_t there = static_cast<int64_t>(to) * count_ + (beside[n] & 255);
      const uint64_t own = patch(there).open;
      bool is_joined = false;
      for (int a = 0; a < 3; ++a)
        is_joined |= ((step[a] > 0 ? from[a] >> beyond_[a] : from[a] << beyond_[a]) & own) != 0;
      if (is_joined) found->push_back(there), open[n] |= own;
    }
  }
}

}  // namespace ggslam::driving
