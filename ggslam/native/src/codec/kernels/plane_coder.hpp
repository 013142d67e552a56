// SPDX-License-Identifier: Apache-2.0
// The planar mode (ISO/IEC 23090-9, first edition): whether the children of a node lie in one half along an axis, and in
// which. It is coded along axes where this was often so lately.
#pragma once
#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <vector>

#include "codec/kernels/tree_neighbours.hpp"

namespace ggslam::GGSLAM_ISA::codec {

struct PlaneContexts {
  Probability is_plane[3], high_first[3], high[3][3][4];
};

class PlaneCoder {
 public:
  explicit PlaneCoder(const std::int32_t* thresholds) {
    for (int k = 0; k < 3; ++k) threshold_[k] = thresholds[k] << 4;
  }

  PlaneContexts& contexts() { return contexts_; }

  // `depth`: levels above, along each axis.
  void begin_level(const int* depth) {
    for (int axis = 0; axis < 3; ++axis)
      last_[axis].assign(std::size_t{1} << std::min(depth[axis], kRowBits), Last{});
  }

  // Learns from the siblings of a node.
  void update(unsigned siblings, int count) {
    for (int axis = 0; axis < 3; ++axis)
      adapt(rate_[axis], !((siblings & kHigh[axis]) && (siblings & (kHigh[axis] ^ 0xff))));
    density_ = (255 * density_ + 1024 * count) >> 8;
  }

  // Axes along which planes are coded now.
  unsigned eligible_axes() const {
    if (density_ >= 3 * 1024) return 0;
    const int first = rate_[0] >= rate_[1] && rate_[0] >= rate_[2] ? 0 : rate_[1] >= rate_[0] && rate_[1] >= rate_[2] ? 1 : 2;
    int second = first == 0 ? 1 : 0, third = 3 - first - second;
    if (rate_[second] < rate_[third]) std::swap(second, third);
    unsigned axes = 0;
    if (rate_[first] >= threshold_[0]) axes |= axis_bit(first);
    if (rate_[second] >= threshold_[1]) axes |= axis_bit(second);
    if (rate_[third] >= threshold_[2]) axes |= axis_bit(third);
    return axes;
  }

  // Codes the planes along `axes`. `octant` is the node's place in its parent; encoder: `occupancy` of the node.
  template <class Coder>
  void code(Coder& coder, unsigned axes, const TreeNode& node, unsigned octant, unsigned pattern, unsigned occupancy,
            PlaneKnowledge& planes) {
    for (int axis = 0; axis < 3; ++axis)
      if (axes & axis_bit(axis)) code_axis(coder, axis, node, octant, pattern, occupancy, planes);
  }

 private:
  static constexpr unsigned kHigh[3] = {0xf0, 0xcc, 0xaa};
  static constexpr int kRowBits = 14;
  struct Last {
    std::uint8_t place = 0;
    std::int8_t half = -2;  // of the last plane in this row; negative: there was none
  };

  static void adapt(int& rate, bool plane) { rate = (255 * rate + (plane ? 256 * 8 : 0) + 128) >> 8; }

  template <class Coder>
  void code_axis(Coder& coder, int axis, const TreeNode& node, unsigned octant, unsigned pattern, unsigned occupancy,
                 PlaneKnowledge& planes) {
    Last& last = last_[axis][node.position[axis] & ((1 << kRowBits) - 1)];
    const int other = axis == 0 ? 1 : 0, another = 3 - axis - other;
    const int place = std::max(node.position[other] >> 3 & 31, node.position[another] >> 3 & 31);
    const unsigned high_half = kHigh[axis];
    const bool low_empty = !(occupancy & (high_half ^ 0xff)), high_empty = !(occupancy & high_half);
    const bool plane = coder.code(Coder::kEncoder && (low_empty || high_empty), contexts_.is_plane[axis]);
    int half = -1;
    if (plane) {
      Probability& p = context_of(axis, last, std::abs(place - last.place) > 1, node, octant, pattern);
      half = coder.code(low_empty, p);
      planes.known[axis] = half ? high_half ^ 0xff : high_half;
    } else {
      planes.possible[axis] = false;
    }
    adapt(rate_[axis], plane);
    last = {static_cast<std::uint8_t>(place), static_cast<std::int8_t>(half)};
  }

  Probability& context_of(int axis, const Last& last, bool far, const TreeNode& node, unsigned octant,
                          unsigned pattern) {
    static constexpr int kLowBit[3] = {1, 2, 4}, kHighBit[3] = {0, 3, 5};
    const bool low = pattern >> kLowBit[axis] & 1;
    const bool high = octant & axis_bit(axis) ? pattern >> kHighBit[axis] & 1 : (node.siblings & kHigh[axis]) != 0;
    const int neighbours = low == high ? 0 : high ? 2 : 1;
    if (last.half < 0) return contexts_.high_first[neighbours];
    return contexts_.high[axis][neighbours][last.half + 2 * far];
  }

  PlaneContexts contexts_;
  std::vector<Last> last_[3];
  int rate_[3] = {128 * 8, 128 * 8, 128 * 8}, density_ = 1024 * 4, threshold_[3];
};

}  // namespace ggslam::GGSLAM_ISA::codec
