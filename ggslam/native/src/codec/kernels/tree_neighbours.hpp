// SPDX-License-Identifier: Apache-2.0
// Neighbours of the nodes of a level in trees whose nodes are not cubes (ISO/IEC 23090-9, first edition). A cube of
// 2^boundary nodes is laid out as bits while the walk is in it; nodes outside count as empty.
#pragma once
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <vector>

#include "codec/kernels/occupancy_coder.hpp"

namespace ggslam::GGSLAM_ISA::codec {

// Positions are in nodes of their own level; `siblings` is the parent's occupancy byte.
struct TreeNode {
  std::int32_t position[3];
  std::uint8_t siblings = 0, sibling_count = 8;
  bool direct = false;      // its points may be coded directly
  std::uint8_t qp = 0;      // of the positions below
  std::uint32_t start = 0, end = 0;  // encoder: its points
};

inline constexpr unsigned axis_bit(int axis) { return 4u >> axis; }

class TreeNeighbours {
 public:
  explicit TreeNeighbours(int boundary)
      : bits_(boundary), side_(1 << boundary), occupied_(allocate(boundary)), children_(allocate(boundary)) {
    for (int i = 0; i < 256; ++i)
      for (int bit = 0; bit < 8; ++bit) spread_[i] |= static_cast<std::uint32_t>(i >> bit & 1) << (3 * bit);
  }

  void begin_level() { inside_ = false; }

  // Lays out the cube of nodes[index]; the nodes of a cube come one after the other.
  void enter(const std::vector<TreeNode>& nodes, std::size_t index, unsigned split_axes) {
    const TreeNode& first = nodes[index];
    if (inside_ && same_cube(first, origin_)) return;
    for (const std::uint32_t place : used_) occupied_[place] = 0;
    used_.clear();
    inside_ = true;
    for (int axis = 0; axis < 3; ++axis) {
      origin_[axis] = first.position[axis] >> bits_;
      shift_[axis] = (split_axes & axis_bit(axis)) != 0;
    }
    for (std::size_t i = index; i < nodes.size() && same_cube(nodes[i], origin_); ++i) {
      int p[3];
      for (int axis = 0; axis < 3; ++axis) p[axis] = (nodes[i].position[axis] & (side_ - 1)) >> shift_[axis];
      const std::uint32_t place = place_of(p[0], p[1], p[2]);
      if (occupied_[place] == 0) used_.push_back(place);
      occupied_[place] = nodes[i].siblings;
    }
  }

  // Notes the children of a coded node.
  void note_children(const TreeNode& node, unsigned occupancy) {
    int p[3];
    local(node, p);
    children_[place_of(p[0], p[1], p[2])] = static_cast<std::uint8_t>(occupancy);
  }

  // What the nodes at the six faces tell; with `adjacent`, also the children of those that are coded.
  NodeContext look(const TreeNode& node, bool adjacent, unsigned split_axes) const {
    static constexpr int kBits[3][2] = {{1, 0}, {2, 3}, {4, 5}};  // of the pattern: lower and higher neighbour
    NodeContext out;
    int p[3];
    local(node, p);
    for (int axis = 0; axis < 3; ++axis)
      for (int side = 0; side < 2; ++side) {
        int q[3] = {p[0], p[1], p[2]};
        q[axis] += side ? 1 : -1;
        if (is_occupied(q)) out.pattern |= 1u << kBits[axis][side];
      }
    if (!adjacent) return out;
    static constexpr unsigned kHighHalf[3] = {0xf0, 0xcc, 0xaa};
    for (int axis = 0; axis < 3; ++axis) {
      const unsigned bit = 1u << kBits[axis][0];
      if (!(out.pattern & bit)) continue;
      int q[3] = {p[0], p[1], p[2]};
      --q[axis];
      const bool split = (split_axes & axis_bit(axis)) != 0;
      const unsigned side = split ? kHighHalf[axis] : kHighHalf[axis] ^ 0xff;
      const int shift = split ? 4 >> axis : 0;
      const unsigned occupancy = children_[place_of(q[0], q[1], q[2])], touching = occupancy & side;
      if (touching == 0) out.pattern ^= bit;
      out.touched_again |= out.touched & (touching >> shift);
      out.touched |= touching >> shift;
      out.open |= (~occupancy & side) >> shift;
    }
    return out;
  }

  // Predicts the children from the 26 nodes around.
  void predict(const TreeNode& node, NodeContext& out) const {
    int p[3], score[8] = {}, count = 0;
    local(node, p);
    for (int dx = -1; dx <= 1; ++dx)
      for (int dy = -1; dy <= 1; ++dy)
        for (int dz = -1; dz <= 1; ++dz) {
          const int q[3] = {p[0] + dx, p[1] + dy, p[2] + dz};
          if ((dx == 0 && dy == 0 && dz == 0) || !is_occupied(q)) continue;
          ++count;
          for (int child = 0; child < 8; ++child)
            score[child] += touches(dx, child >> 2) && touches(dy, child >> 1 & 1) && touches(dz, child & 1);
        }
    const int full = count < 14 ? 4 : 5;
    for (int child = 0; child < 8; ++child) {
      out.predicted_any |= static_cast<unsigned>(score[child] <= 2 || score[child] >= full) << child;
      out.predicted_full |= static_cast<unsigned>(score[child] >= full) << child;
    }
  }

 private:
  struct Free {
    void operator()(std::uint8_t* p) const { std::free(p); }
  };
  using Bytes = std::unique_ptr<std::uint8_t[], Free>;

  // Zeroed memory, of which only the pages that are touched are there.
  static Bytes allocate(int boundary) {
    Bytes bytes(static_cast<std::uint8_t*>(std::calloc(std::size_t{1} << (3 * boundary), 1)));
    if (!bytes) throw std::bad_alloc();
    return bytes;
  }
  static bool touches(int offset, int child) { return offset == 0 || (offset < 0) == (child == 0); }

  bool same_cube(const TreeNode& node, const std::int32_t* origin) const {
    return node.position[0] >> bits_ == origin[0] && node.position[1] >> bits_ == origin[1] &&
           node.position[2] >> bits_ == origin[2];
  }
  void local(const TreeNode& node, int* p) const {
    for (int axis = 0; axis < 3; ++axis) p[axis] = node.position[axis] & (side_ - 1);
  }
  std::uint32_t place_of(int x, int y, int z) const { return spread_[x] << 2 | spread_[y] << 1 | spread_[z]; }

  bool is_occupied(const int* p) const {
    int octant = 0, q[3];
    for (int axis = 0; axis < 3; ++axis) {
      if (p[axis] < 0 || p[axis] >= side_) return false;
      q[axis] = p[axis] >> shift_[axis];
      if (shift_[axis]) octant |= (p[axis] & 1) << (2 - axis);
    }
    return occupied_[place_of(q[0], q[1], q[2])] >> octant & 1;
  }

  const int bits_, side_;
  Bytes occupied_, children_;  // by parent: its occupancy byte; by node: that of the node
  std::vector<std::uint32_t> used_;
  std::uint32_t spread_[256] = {};
  std::int32_t origin_[3] = {};
  int shift_[3] = {};
  bool inside_ = false;
};

}  // namespace ggslam::GGSLAM_ISA::codec
