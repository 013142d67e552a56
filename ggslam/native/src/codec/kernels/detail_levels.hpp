// SPDX-License-Identifier: Apache-2.0
// Levels of detail for the predicting and the lifting transform (ISO/IEC 23090-9, first edition): points are taken out
// level by level, the finest first, and each is given up to three neighbours among those that are left, or among those
// before it in its own level.
#pragma once
#include <algorithm>
#include <array>
#include <cstdint>
#include <cstdlib>
#include <limits>
#include <vector>

#include "codec/gpcc.hpp"

namespace ggslam::GGSLAM_ISA::codec {

using gpcc::DetailSettings;
using DetailPoint = std::array<std::int32_t, 3>;

inline std::int64_t half_away(std::int64_t value, int shift) {
  const std::int64_t half = std::int64_t{1} << (shift - 1);
  return value >= 0 ? (value + half) >> shift : -((half - value) >> shift);
}

// About 2^scale a / b, by a divisor of 8 bits.
inline std::int64_t divide(std::int64_t a, std::uint64_t b, int scale) {
  const int n = std::max(0, 63 - __builtin_clzll(b) + 1 - 8);
  const std::int64_t index = static_cast<std::int64_t>((b + ((std::uint64_t{1} << n) >> 1)) >> n);
  return (65536 + index / 2) / index * a >> (n + 16 - scale);
}

constexpr int kWeightBits = 8;  // of the weights of neighbours

struct Predictor {
  int count = 0;
  std::uint32_t neighbour[3] = {};
  std::uint64_t weight[3] = {};  // squared distances, then weights

  void order_by_distance() {
    const auto swap_if = [&](int a, int b) {
      if (count > b && weight[a] > weight[b]) std::swap(weight[a], weight[b]), std::swap(neighbour[a], neighbour[b]);
    };
    swap_if(0, 1);
    if (count > 2 && weight[1] > weight[2]) {
      swap_if(1, 2);
      swap_if(0, 1);
    }
    if (count < 2) weight[0] = 1;
    if (count >= 2 && weight[0] == 0) count = 1, weight[0] = 1;
  }

  // Weights from squared distances: inverse to them, with a sum of 2^8.
  void weigh() {
    constexpr std::uint64_t one = 1 << kWeightBits;
    int n = 0;
    while (weight[0] >> n >= one) ++n;
    if (n > 0)
      for (int i = 0; i < count; ++i) weight[i] = (weight[i] + (std::uint64_t{1} << (n - 1))) >> n;
    while (count > 1 && weight[count - 1] >= weight[0] << kWeightBits) --count;
    const std::uint64_t d0 = weight[0], d1 = weight[1], d2 = weight[2];
    if (count <= 1) {
      weight[0] = one;
    } else if (count == 2) {
      weight[1] = part(d0, d1 + d0);
      weight[0] = static_cast<std::uint32_t>(one - weight[1]);
    } else {
      const std::uint64_t sum = d1 * d2 + d0 * d2 + d0 * d1;
      weight[2] = part(d0 * d1, sum);
      weight[1] = part(d0 * d2, sum);
      weight[0] = static_cast<std::uint32_t>(one - (weight[1] + weight[2]));
    }
  }

 private:
  static std::uint64_t part(std::uint64_t a, std::uint64_t sum) {
    return static_cast<std::uint32_t>(divide(static_cast<std::int64_t>(a), std::max<std::uint64_t>(sum, 1), kWeightBits));
  }
};

// The three nearest points found so far, by the sum of the coordinates' differences. Of equals the first stays.
struct Nearest {
  std::int32_t index[3] = {-1, -1, -1};
  std::int64_t distance[3] = {kFar, kFar, kFar};
  static constexpr std::int64_t kFar = std::numeric_limits<std::int64_t>::max();

  bool full() const { return index[2] != -1; }
  int count() const { return (index[0] != -1) + (index[1] != -1) + (index[2] != -1); }
  void add(std::int32_t candidate, std::int64_t d) {
    if (d >= distance[2]) return;
    int at = d < distance[0] ? 0 : d < distance[1] ? 1 : 2;
    for (int i = 2; i > at; --i) index[i] = index[i - 1], distance[i] = distance[i - 1];
    index[at] = candidate, distance[at] = d;
  }
  void add_new(std::int32_t candidate, std::int64_t d) {
    if (candidate != index[0] && candidate != index[1] && candidate != index[2]) add(candidate, d);
  }
};

inline std::int64_t distance1(const DetailPoint& a, const DetailPoint& b) {
  std::int64_t sum = 0;
  for (int k = 0; k < 3; ++k) sum += std::abs(static_cast<std::int64_t>(a[k]) - b[k]);
  return sum;
}

inline std::int64_t distance2(const DetailPoint& a, const DetailPoint& b) {
  std::int64_t sum = 0;
  for (int k = 0; k < 3; ++k) sum += (static_cast<std::int64_t>(a[k]) - b[k]) * (static_cast<std::int64_t>(a[k]) - b[k]);
  return sum;
}

// Boxes around runs of 32, 1024 and 32768 points: runs that lie too far are passed over.
class RunBoxes {
 public:
  static constexpr int kBits = 5, kLevels = 3;

  template <class PointOf>
  void build(std::int32_t count, const PointOf& point) {
    std::int32_t size = count;
    for (auto& level : boxes_) {
      size = (size + (1 << kBits) - 1) >> kBits;
      level.assign(static_cast<std::size_t>(size), Box{});
    }
    for (std::int32_t i = 0; i < count; ++i)
      for (int level = 0; level < kLevels; ++level) box(i, level).add(point(i));
  }

  // visit(i) for i from `first` to `last`, in steps of +1 or -1, but for runs whose box lies at skip() or further.
  template <class Skip, class Visit>
  void scan(std::int32_t first, std::int32_t last, int step, const DetailPoint& from, const Skip& skip,
            const Visit& visit) {
    for (std::int32_t i = first; step > 0 ? i <= last : i >= last;) {
      bool passed = false;
      for (int level = kLevels - 1; level >= 0 && !passed; --level) {
        if (!at_run_start(i, first, level, step) || !skip(box(i, level).distance(from))) continue;
        const int bits = kBits * (level + 1);
        i = step > 0 ? ((i >> bits) + 1) << bits : ((i >> bits) << bits) - 1;
        passed = true;
      }
      if (passed) continue;
      visit(i);
      i += step;
    }
  }

 private:
  struct Box {
    DetailPoint low{kMax, kMax, kMax}, high{-kMax, -kMax, -kMax};
    static constexpr std::int32_t kMax = std::numeric_limits<std::int32_t>::max();
    void add(const DetailPoint& p) {
      for (int k = 0; k < 3; ++k) low[k] = std::min(low[k], p[k]), high[k] = std::max(high[k], p[k]);
    }
    std::int64_t distance(const DetailPoint& p) const {
      std::int64_t sum = 0;
      for (int k = 0; k < 3; ++k)
        sum += std::max({static_cast<std::int64_t>(low[k]) - p[k], std::int64_t{0}, static_cast<std::int64_t>(p[k]) - high[k]});
      return sum;
    }
  };
  Box& box(std::int32_t i, int level) { return boxes_[level][static_cast<std::size_t>(i >> (kBits * (level + 1)))]; }
  static bool at_run_start(std::int32_t i, std::int32_t first, int level, int step) {
    const std::int32_t mask = (1 << (kBits * (level + 1))) - 1;
    return i == first || (step > 0 ? (i & mask) == 0 : (i & mask) == mask);
  }
  std::vector<Box> boxes_[kLevels];
};

class DetailLevels {
 public:
  DetailLevels(const DetailSettings& settings, const std::vector<DetailPoint>& points,
               const std::vector<std::uint64_t>& codes)
      : s_(settings), points_(points), codes_(codes) {}

  // False if finding neighbours takes more steps than any sensible stream needs.
  bool build();

  std::vector<std::uint32_t> order;      // points, the finest level first
  std::vector<Predictor> predictors;     // in that order; neighbours are places in it
  std::vector<std::uint32_t> level_sizes;  // points down to each level, the coarsest first

 private:
  static constexpr int kCubeBits = 21;  // of a code within 2^7 cubes along each axis
  static constexpr int kNear = 2;

  struct Window {  // of the points that are left, those near a point's cube are looked for
    std::int64_t id = -1;
    std::int32_t begin = 0, end = 0;
  };

  void thin_out(int level, const std::vector<std::uint32_t>& input, std::vector<std::uint32_t>& left);
  void thin_out_by_distance(int level, const std::vector<std::uint32_t>& input, std::vector<std::uint32_t>& left);
  void thin_out_by_cubes(int level, const std::vector<std::uint32_t>& input, std::vector<std::uint32_t>& left);
  std::uint32_t middle_of(const std::vector<std::uint32_t>& voxels, int size) const;
  void find_neighbours(int level, std::size_t begin, const std::vector<std::uint32_t>& left);
  void search_left(const std::vector<std::uint32_t>& left, std::int32_t& at, std::uint32_t point, int shift, int window_shift,
                   Nearest& nearest);
  void search_level(std::size_t begin, std::size_t at, std::uint32_t point, Nearest& nearest);
  void enter_window(const std::vector<std::uint32_t>& left, std::uint64_t code, int window_shift);
  void collect_around(const std::vector<std::uint32_t>& left, std::uint64_t cube, int shift);

  std::uint64_t shifted_code(std::uint32_t point, int shift) const { return shift > 63 ? 0 : codes_[point] >> shift; }

  const DetailSettings& s_;
  const std::vector<DetailPoint>& points_;
  const std::vector<std::uint64_t>& codes_;
  std::vector<DetailPoint> biased_;
  RunBoxes left_boxes_, level_boxes_;
  Window window_;
  std::uint64_t last_cube_ = 0;
  bool have_cube_ = false;
  std::vector<std::int32_t> around_;
  std::uint64_t steps_ = 0;
};

}  // namespace ggslam::GGSLAM_ISA::codec
