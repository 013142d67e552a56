// SPDX-License-Identifier: Apache-2.0
// Points whose positions are coded directly, without a tree below their node (ISO/IEC 23090-9, first edition: inferred
// direct coding mode), and positions on a coarser grid (in-tree geometry quantisation).
#pragma once
#include <algorithm>
#include <cstdint>

#include "codec/kernels/exp_golomb.hpp"
#include "codec/kernels/tree_neighbours.hpp"

namespace ggslam::GGSLAM_ISA::codec {

struct DirectContexts {
  Probability is_direct, two_points, same_bit[3][5], three_duplicates;
};

// Whether the points of a child may be coded directly. `largest` is the logarithm of the node's longest side.
inline bool is_direct_candidate(int mode, int largest, unsigned pattern, int siblings_of_node, int siblings_of_child) {
  if (largest < 2) return false;
  switch (mode) {
    case 1: return pattern == 0 && siblings_of_child == 1 && siblings_of_node <= 2;
    case 2: return pattern == 0;
    case 3: return siblings_of_child > 1;
    default: return false;
  }
}

// Of 32 candidates in turn, those that may be coded directly, bit by bit.
inline std::uint32_t direct_mask(int mode, bool planes, int rate) {
  if (mode != 1 || !planes) return 0xffffffff;
  std::uint32_t mask = 0;
  for (int i = 0, sum = 0; i < 32; ++i) {
    sum += rate;
    mask |= static_cast<std::uint32_t>(sum >= 32) << i;
    sum &= 31;
  }
  return mask;
}

// A position of the tree on the grid of the slice: its low bits (those of `mask`) were divided by a step of
// 2^(qp / 8) (8 + qp % 8) / 8.
inline std::int32_t scaled_position(std::int32_t position, std::uint32_t mask, int qp) {
  const int shift = qp >> 3;
  const auto low = static_cast<std::int64_t>(static_cast<std::uint32_t>(position) & (mask >> shift));
  const std::int64_t step = static_cast<std::int64_t>(8 + (qp & 7)) << shift;
  const std::int64_t scaled = std::min<std::int64_t>((low * step + 4) >> 3, mask);
  return static_cast<std::int32_t>((static_cast<std::int64_t>(position) - low) << shift | scaled);
}

// The position of a tree of sides of 2^side whose scaled position is the nearest, shifted so that its highest bit stays
// where it would be without a step.
inline std::int32_t quantised_position(std::int32_t position, int side, int qp) {
  const int shift = qp >> 3;
  const std::int64_t step = static_cast<std::int64_t>(8 + (qp & 7)) << shift;
  const std::int64_t most = (std::int64_t{1} << std::max(0, side - shift)) - 1;
  return static_cast<std::int32_t>(std::min((8 * std::int64_t{position} + step / 2) / step, most) << shift);
}

inline std::int32_t shifted(std::int32_t value, int bits) { return bits >= 0 ? value << bits : value >> -bits; }

// What two points' positions begin with, along one axis, until they differ. `equal`: they are the same along the axes
// before; then the first that differs is the lower one's.
template <class Decoder>
void decode_common_bits(Decoder& coder, Probability (&same_bit)[5], bool equal, int& bits, std::int32_t& first,
                        std::int32_t& second) {
  bool same = true;
  for (int i = 0; bits > 0 && same; ++i) {
    --bits;
    same = coder.code(0, same_bit[std::min(i, 4)]) != 0;
    const int bit = equal && !same ? 0 : coder.bypass(0);
    first = first << 1 | bit;
    second = second << 1 | (same ? bit : !bit);
  }
}

// The points of a node of size 2^size: emit(x, y, z) is called for each, relative to the node.
template <class Decoder, class Emit>
void decode_direct_points(Decoder& coder, DirectContexts& contexts, OccupancyContexts& counts, bool unique, bool pairs,
                          const int* size, const PlaneKnowledge& planes, const Emit& emit) {
  const int points = 1 + coder.code(0, contexts.two_points);
  std::uint32_t copies = 0;
  if (!unique && points == 1 && coder.code(0, counts.several_points)) {
    copies = 1 + coder.code(0, contexts.three_duplicates);
    if (copies == 2) copies += code_exp_golomb(coder, 0, 0, counts.more_points);
  }
  int bits[3];
  std::int32_t position[2][3] = {};
  for (int axis = 0; axis < 3; ++axis) {
    bits[axis] = std::max(size[axis], 0);
    if (bits[axis] == 0 || !planes.known[axis]) continue;
    --bits[axis];
    position[0][axis] = position[1][axis] = static_cast<std::int32_t>(planes.known[axis] & 1);
  }
  bool equal = true;
  if (points == 2 && pairs)
    for (int axis = 0; axis < 3; ++axis) {
      decode_common_bits(coder, contexts.same_bit[axis], equal, bits[axis], position[0][axis], position[1][axis]);
      equal = equal && position[0][axis] == position[1][axis];
    }
  for (int point = 0; point < points && !coder.failed(); ++point) {
    for (int axis = 0; axis < 3; ++axis)
      for (int bit = 0; bit < bits[axis]; ++bit) position[point][axis] = position[point][axis] << 1 | coder.bypass(0);
    emit(position[point]);
  }
  for (; copies > 0 && !coder.failed(); --copies)
    if (!emit(position[0])) return;
}

}  // namespace ggslam::GGSLAM_ISA::codec
