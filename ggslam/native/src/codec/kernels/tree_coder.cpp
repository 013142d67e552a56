// SPDX-License-Identifier: Apache-2.0
// Tree geometry with every tool of the Main profile (ISO/IEC 23090-9, first edition), level by level: the same walk codes
// and decodes. octree_coder.cpp does the same, several times as fast, where all levels split all axes and none of the
// tools are used.
#include <algorithm>
#include <optional>

#include "codec/gpcc.hpp"
#include "codec/kernels/direct_points.hpp"
#include "codec/kernels/plane_coder.hpp"
#include "codec/kernels/stream_decoder.hpp"

namespace ggslam::GGSLAM_ISA {
namespace codec {
namespace {

using gpcc::Status;
using gpcc::TreeSettings;

struct TreeContexts {
  OccupancyContexts occupancy;
  PlaneContexts planes;
  DirectContexts direct;
  Probability qp_offset, qp_sign, qp_rest;
};

constexpr int kMaxQp = 8 * 20;

template <class Coder>
class TreeWalk {
 public:
  TreeWalk(const TreeSettings& settings, Coder& coder, std::uint64_t max_points)
      : s_(settings), coder_(coder), max_points_(max_points), occupancy_(settings.neighbour_boundary < 2),
        planes_(settings.plane_thresholds) {
    if (settings.neighbour_boundary >= 2) neighbours_.emplace(settings.neighbour_boundary);
  }

  // Encoder: keys of the points, sorted, with the bits of all levels from the top.
  void set_points(const std::uint64_t* keys, std::uint32_t count) { keys_ = keys, count_ = count; }
  // Decoder: positions [*, 3] are appended.
  void set_output(std::vector<std::int32_t>& out) { out_ = &out; }

  void load(const gpcc::Memory& memory) {
    TreeContexts contexts;
    memory.load(contexts);
    restore(contexts);
  }
  void save(gpcc::Memory& memory) { memory.save(contexts()); }

  Status run() {
    measure_levels();
    std::vector<TreeNode> nodes(1), below;
    nodes[0].position[0] = nodes[0].position[1] = nodes[0].position[2] = 0;
    nodes[0].end = count_;
    std::optional<Saved> saved;
    for (level_ = 0; level_ < s_.levels; ++level_) {
      begin_level();
      const int parallel = s_.levels - s_.codewords;  // the level whose contexts the codewords begin with
      if (s_.codewords > 1 && level_ == parallel) saved.emplace(Saved{contexts(), planes_});
      if (s_.codewords > 1 && level_ > parallel) {
        planes_ = saved->planes;
        restore(saved->contexts);
        if constexpr (!Coder::kEncoder) coder_.restart();
      }
      const int depth[3] = {size_[0][0] - here_[0], size_[0][1] - here_[1], size_[0][2] - here_[2]};
      if (s_.planes) planes_.begin_level(depth);
      if (neighbours_) neighbours_->begin_level();
      below.clear();
      for (std::size_t i = 0; i < nodes.size(); ++i) {
        code_node(nodes, i, below);
        if (coder_.failed()) return gpcc::kTruncated;
        if (points_ > max_points_ || below.size() > max_points_) return gpcc::kCountMismatch;
      }
      nodes.swap(below);
    }
    return points_ == max_points_ ? gpcc::kOk : gpcc::kCountMismatch;
  }

 private:
  struct Saved {
    TreeContexts contexts;
    PlaneCoder planes;
  };

  TreeContexts contexts() {
    TreeContexts all = rest_;
    all.occupancy = occupancy_.contexts();
    all.planes = planes_.contexts();
    return all;
  }
  void restore(const TreeContexts& all) {
    rest_ = all;
    occupancy_.contexts() = all.occupancy;
    planes_.contexts() = all.planes;
  }

  // Sizes of the nodes of each level, logarithms; size_[levels] is that of the leaves.
  void measure_levels() {
    for (int level = s_.levels - 1; level >= 0; --level)
      for (int axis = 0; axis < 3; ++axis)
        size_[level][axis] = size_[level + 1][axis] + ((s_.axes[level] & axis_bit(axis)) != 0);
    key_bits_ = size_[0][0] + size_[0][1] + size_[0][2];
    qp_known_ = !s_.scaling;
    mask_[0] = mask_[1] = mask_[2] = 0xffffffff;
  }

  void begin_level() {
    here_ = size_[level_];
    below_ = size_[level_ + 1];
    axes_ = s_.axes[level_];
    axes_above_ = level_ > 0 ? s_.axes[level_ - 1] : 7;
    for (int axis = 0; axis < 3; ++axis) key_bits_ -= (axes_ & axis_bit(axis)) != 0;
    largest_ = std::max({here_[0], here_[1], here_[2]});
    qp_here_ = !qp_known_ && coder_.bypass(1);  // the encoder's: the root has it
    direct_mask_ = direct_mask(s_.direct_mode, s_.planes != 0, s_.direct_rate);
    const int turn = level_ & 31;
    if (turn != 0) direct_mask_ = direct_mask_ >> turn | direct_mask_ << (32 - turn);
    if (qp_here_) {
      qp_known_ = true;
      direct_qp_ = 0;
      for (int axis = 0; axis < 3; ++axis) mask_[axis] = (1u << here_[axis]) - 1;
    }
    if (qp_known_) return;
    int quantised[3];
    for (int axis = 0; axis < 3; ++axis) {
      quantised[axis] = std::max(0, here_[axis] - (s_.planes != 0));
      mask_[axis] = (1u << quantised[axis]) - 1;
    }
    direct_qp_ = std::clamp(s_.direct_qp, 0, 8 * std::min({quantised[0], quantised[1], quantised[2]}));
  }

  void code_node(std::vector<TreeNode>& nodes, std::size_t index, std::vector<TreeNode>& children) {
    if (neighbours_) neighbours_->enter(nodes, index, axes_above_);
    TreeNode& node = nodes[index];
    if (qp_here_) node.qp = code_qp();
    const int dropped = node.qp >> 3;
    unsigned axes = axes_;  // along which this node is split: the scaled position has no bits left along others
    int size[3];
    bool leaf = true;
    for (int axis = 0; axis < 3; ++axis) {
      size[axis] = here_[axis] - dropped;
      leaf = leaf && size[axis] <= 0;
      if (dropped && below_[axis] - dropped < 0) axes &= ~axis_bit(axis);
    }
    const unsigned octant = ((node.position[0] & 1) << 2 | (node.position[1] & 1) << 1 | (node.position[2] & 1)) &
                            axes_above_;
    NodeContext context;
    if (neighbours_)
      context = neighbours_->look(node, s_.adjacent_child != 0, axes_);
    else
      context.pattern = sibling_pattern(node.siblings, octant);
    if (s_.planes && nodes_to_update_-- == 0) {
      planes_.update(node.siblings, node.sibling_count);
      nodes_to_update_ = node.sibling_count - 1;
    }
    PlaneKnowledge planes;
    unsigned occupancy = leaf ? 1 : 0;
    if (Coder::kEncoder && !leaf) occupancy = occupancy_of(node);
    if (!leaf) {
      if (s_.planes)
        planes_.code(coder_, planes_.eligible_axes() & axes, node, octant, context.pattern, occupancy, planes);
      if constexpr (!Coder::kEncoder)
        if (node.direct && coder_.code(0, rest_.direct.is_direct)) {
          decode_points(node, size, planes);
          return;
        }
      occupancy = code_occupancy(node, axes, occupancy, context, planes);
    }
    if (coder_.failed()) return;
    if (neighbours_) neighbours_->note_children(node, occupancy);
    add_children(node, occupancy, dropped, context.pattern, children);
  }

  static unsigned sibling_pattern(unsigned siblings, unsigned octant) {
    return (siblings >> (octant ^ 4) & 1) << (octant >> 2 & 1) | (siblings >> (octant ^ 2) & 1) << (octant & 2 ? 2 : 3) |
           (siblings >> (octant ^ 1) & 1) << (octant & 1 ? 4 : 5);
  }

  unsigned code_occupancy(const TreeNode& node, unsigned axes, unsigned occupancy, NodeContext& context,
                          PlaneKnowledge& planes) {
    static constexpr unsigned kHigh[3] = {0xf0, 0xcc, 0xaa};
    unsigned known = 0;
    for (int axis = 0; axis < 3; ++axis) {
      if (!(axes & axis_bit(axis))) planes.known[axis] = kHigh[axis];
      known |= planes.known[axis];
    }
    if (neighbours_ && largest_ < s_.intra_prediction && known == 0) neighbours_->predict(node, context);
    return occupancy_.code_with_planes(coder_, occupancy, context, planes);
  }

  std::uint8_t code_qp() {
    int offset = 0;  // the encoder's
    if (coder_.code(0, rest_.qp_offset)) {
      offset = 1 + static_cast<int>(std::min<std::uint32_t>(code_exp_golomb(coder_, 0, 0, rest_.qp_rest), 1 << 16));
      if (coder_.code(0, rest_.qp_sign)) offset = -offset;
    }
    return static_cast<std::uint8_t>(std::clamp(s_.slice_qp + (offset << s_.qp_shift), 0, kMaxQp));
  }

  // Where a key's bits say that a point lies.
  unsigned octant_of(std::uint64_t key) const {
    unsigned octant = 0;
    int bit = key_bits_;
    for (int axis = 2; axis >= 0; --axis)
      if (axes_ & axis_bit(axis)) octant |= static_cast<unsigned>(key >> bit++ & 1) << (2 - axis);
    return octant;
  }
  unsigned occupancy_of(const TreeNode& node) const {
    unsigned occupancy = 0;
    for (std::uint32_t i = node.start; i < node.end; ++i) occupancy |= 1u << octant_of(keys_[i]);
    return occupancy;
  }

  void add_children(const TreeNode& node, unsigned occupancy, int dropped, unsigned pattern,
                    std::vector<TreeNode>& children) {
    const int count = __builtin_popcount(occupancy);
    const bool leaf = below_[0] <= dropped && below_[1] <= dropped && below_[2] <= dropped;
    std::uint32_t start = node.start;
    for (unsigned rest = occupancy; rest != 0; rest &= rest - 1) {
      const unsigned octant = __builtin_ctz(rest);
      TreeNode child;
      for (int axis = 0; axis < 3; ++axis)
        child.position[axis] = node.position[axis] << ((axes_ & axis_bit(axis)) != 0) | (octant >> (2 - axis) & 1);
      if (Coder::kEncoder) {
        child.start = start;
        while (start < node.end && octant_of(keys_[start]) == octant) ++start;
        child.end = start;
      }
      if (leaf) {
        code_leaf(node, child, dropped);
        if (coder_.failed() || points_ > max_points_) return;
        continue;
      }
      child.siblings = static_cast<std::uint8_t>(occupancy);
      child.sibling_count = static_cast<std::uint8_t>(count);
      child.qp = node.qp;
      if (is_direct_candidate(s_.direct_mode, largest_, pattern, node.sibling_count, count)) {
        child.direct = direct_mask_ & 1;
        direct_mask_ = direct_mask_ >> 1 | direct_mask_ << 31;
      }
      children.push_back(child);
    }
  }

  void code_leaf(const TreeNode& node, const TreeNode& leaf, int dropped) {
    std::uint32_t count = 1;
    if (!s_.unique_points) count = occupancy_.code_leaf_points(coder_, leaf.end - leaf.start);
    if constexpr (Coder::kEncoder) {
      points_ += s_.unique_points ? leaf.end - leaf.start : count;
    } else {
      std::int32_t position[3];
      for (int axis = 0; axis < 3; ++axis) position[axis] = shifted(leaf.position[axis], below_[axis] - dropped);
      for (; count > 0; --count)
        if (!emit(position, node.qp)) return;
    }
  }

  void decode_points(const TreeNode& node, const int* size, const PlaneKnowledge& planes) {
    const int qp = direct_qp_ ? direct_qp_ : node.qp;
    int own_size[3];
    for (int axis = 0; axis < 3; ++axis) own_size[axis] = direct_qp_ ? here_[axis] - (direct_qp_ >> 3) : size[axis];
    decode_direct_points(coder_, rest_.direct, occupancy_.contexts(), s_.unique_points != 0, s_.direct_pairs != 0,
                         own_size, planes, [&](const std::int32_t* offset) {
                           std::int32_t position[3];
                           for (int axis = 0; axis < 3; ++axis)
                             position[axis] = shifted(node.position[axis], own_size[axis]) + offset[axis];
                           return emit(position, qp);
                         });
    if (neighbours_) neighbours_->note_children(node, 0);
  }

  // False once there are more points than there should be.
  bool emit(const std::int32_t* position, int qp) {
    if (++points_ > max_points_) return false;
    for (int axis = 0; axis < 3; ++axis) out_->push_back(scaled_position(position[axis], mask_[axis], qp));
    return true;
  }

  const TreeSettings& s_;
  Coder& coder_;
  const std::uint64_t max_points_;
  OccupancyModel occupancy_;
  PlaneCoder planes_;
  TreeContexts rest_;  // but those of occupancy_ and planes_
  std::optional<TreeNeighbours> neighbours_;
  const std::uint64_t* keys_ = nullptr;
  std::uint32_t count_ = 0;
  std::vector<std::int32_t>* out_ = nullptr;
  std::uint64_t points_ = 0;

  int level_ = 0, largest_ = 0, key_bits_ = 0;
  int size_[65][3] = {};
  const int *here_ = nullptr, *below_ = nullptr;  // sizes of the nodes of this level and of the next
  unsigned axes_ = 7, axes_above_ = 7;
  std::uint32_t mask_[3];  // bits of positions that are scaled
  bool qp_known_ = true, qp_here_ = false;
  int direct_qp_ = 0, nodes_to_update_ = 1;
  std::uint32_t direct_mask_ = 0;
};

}  // namespace
}  // namespace codec

// Sorted keys of points [count, 3]: the bits of their positions level by level, from the top; where positions are scaled,
// those of the nearest step, without the levels that it leaves out.
void tree_keys(const std::int32_t* points, std::size_t count, const gpcc::TreeSettings& settings,
               std::vector<std::uint64_t>& keys) {
  keys.assign(count, 0);
  int bits[3] = {}, sides[3] = {};
  for (int level = 0; level < settings.levels; ++level)
    for (int axis = 0; axis < 3; ++axis) sides[axis] += (settings.axes[level] & codec::axis_bit(axis)) != 0;
  const int qp = settings.scaling ? settings.slice_qp : 0;
  for (int level = settings.levels - 1, place = 0; level >= 0; --level)
    for (int axis = 2; axis >= 0; --axis) {
      if (!(settings.axes[level] & codec::axis_bit(axis))) continue;
      for (std::size_t i = 0; i < count; ++i) {
        const std::int32_t position = codec::quantised_position(points[3 * i + axis], sides[axis], qp);
        keys[i] |= static_cast<std::uint64_t>(position >> bits[axis] & 1) << place;
      }
      ++bits[axis];
      ++place;
    }
  std::sort(keys.begin(), keys.end());
}

// Codes the tree of `count` points by their sorted keys (the bits of all levels, from the top).
void tree_encode(const gpcc::TreeSettings& settings, const std::uint64_t* keys, std::uint32_t count,
                 std::vector<std::uint8_t>& out) {
  codec::BinaryEncoder coder(out);
  codec::TreeWalk<codec::BinaryEncoder> walk(settings, coder, count);
  walk.set_points(keys, count);
  walk.run();
  coder.finish();
}

// Decodes `points` points; positions [points, 3] in the order of the stream. `memory` holds the contexts to begin with
// and receives those that it ended with.
gpcc::Status tree_decode(const gpcc::TreeSettings& settings, const std::uint8_t* data, std::size_t size,
                         std::uint64_t points, gpcc::Memory& memory, std::vector<std::int32_t>& out) {
  codec::StreamDecoder coder(data, size, settings.separate_bits != 0);
  codec::TreeWalk<codec::StreamDecoder> walk(settings, coder, points);
  walk.load(memory);
  walk.set_output(out);
  const gpcc::Status status = walk.run();
  walk.save(memory);
  return status;
}

}  // namespace ggslam::GGSLAM_ISA
