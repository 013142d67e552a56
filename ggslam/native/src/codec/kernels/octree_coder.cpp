// SPDX-License-Identifier: Apache-2.0
// Octree geometry (ISO/IEC 23090-9, first edition), level by level: the same walk codes and decodes.
#include <utility>

#include "codec/gpcc.hpp"
#include "codec/kernels/neighbourhood.hpp"
#include "codec/kernels/occupancy_coder.hpp"

namespace ggslam::GGSLAM_ISA {
namespace codec {
namespace {

using gpcc::Octree;
using gpcc::OctreeSettings;
using gpcc::Status;

// Windows around a node, by the side of the cube it lies at: nodes on the other side are not looked at.
std::uint64_t within_cube(std::uint64_t around, std::uint64_t code, int boundary) {
  const std::uint64_t low_bits = (std::uint64_t{1} << (3 * boundary)) - 1;
  const std::uint64_t z_bits = 0x1249249249249249ull & low_bits, y_bits = z_bits << 1, x_bits = z_bits << 2;
  if ((code & x_bits) == 0) around &= ~0x0000000000000fffull;
  if ((code & x_bits) == x_bits) around &= ~0x00000fff00000000ull;
  if ((code & y_bits) == 0) around &= ~0x0000000f000f000full;
  if ((code & y_bits) == y_bits) around &= ~0x00000f000f000f00ull;
  if ((code & z_bits) == 0) around &= ~0x0000011101110111ull;
  if ((code & z_bits) == z_bits) around &= ~0x0000044404440444ull;
  return around;
}

unsigned face_pattern(std::uint64_t around) {
  return static_cast<unsigned>((around >> 37 & 1) | (around >> 5 & 1) << 1 | (around >> 17 & 1) << 2 |
                               (around >> 25 & 1) << 3 | (around >> 20 & 1) << 4 | (around >> 22 & 1) << 5);
}

// A child is predicted by the number of occupied nodes, of the 26 around its parent, that it touches.
void predict(std::uint64_t around, NodeContext& node) {
  const int full = __builtin_popcountll(around) - 1 >= 14 ? 5 : 4;
  for (int child = 0; child < 8; ++child) {
    const int score = __builtin_popcountll(around & (0x330033ull << window_shift(child))) - 1;
    node.predicted_any |= static_cast<unsigned>(score <= 2 || score >= full) << child;
    node.predicted_full |= static_cast<unsigned>(score >= full) << child;
  }
}

// What the children of one coded neighbour, on the low side of an axis, tell: `side` are its children that touch.
void add_adjacent(unsigned occupancy, unsigned side, int shift, unsigned pattern_bit, NodeContext& node) {
  const unsigned touching = occupancy & side;
  if (touching == 0) node.pattern &= ~pattern_bit;
  node.touched_again |= node.touched & (touching >> shift);
  node.touched |= touching >> shift;
  node.open |= (~occupancy & side) >> shift;
}

template <class Coder>
class Walk {
 public:
  Walk(const OctreeSettings& settings, Coder& coder, Octree& tree, std::uint64_t max_points)
      : settings_(settings), coder_(coder), tree_(tree), max_points_(max_points),
        siblings_only_(settings.neighbour_boundary < 2), model_(siblings_only_) {}

  Status run() {
    if (!Coder::kEncoder) begin_decoding();
    std::uint64_t nodes = 0;
    for (int depth = 0; depth < settings_.depth; ++depth) {
      begin_level(depth);
      nodes += tree_.levels[depth].size();
      if (nodes > gpcc::kMaxNodes) return gpcc::kTooLarge;
      const Status status = depth == 0 ? root() : level(depth);
      if (status != gpcc::kOk) return status;
      std::swap(parent_links_, links_);
      std::swap(parent_codes_, codes_);
    }
    tree_.leaves = next_child_ - 1;
    tree_.points = points_;
    return gpcc::kOk;
  }

 private:
  void begin_decoding() {
    tree_ = Octree{};
    tree_.levels.resize(settings_.depth);
    tree_.levels[0].occupancy.assign(2, 0);
    if (!settings_.unique_points) tree_.leaf_points.assign(1, 0);
  }

  void begin_level(int depth) {
    Level& here = tree_.levels[depth];
    const std::uint32_t count = here.size();
    keep_links_ = !siblings_only_ && depth + 1 < settings_.depth;
    bounded_ = depth > settings_.neighbour_boundary;
    leaves_below_ = depth + 1 == settings_.depth;
    if (keep_links_) links_.clear(count);
    codes_.resize(siblings_only_ ? 0 : count + 1);
    next_child_ = 1;
    if (Coder::kEncoder) return;
    here.first_child.assign(count + 1, 0);
    if (!leaves_below_) tree_.levels[depth + 1].occupancy.assign(1, 0);
  }

  Status root() {
    if (!siblings_only_) codes_[1] = 0;
    NodeContext node;
    if (settings_.depth < settings_.intra_prediction) predict(std::uint64_t{1} << kCentreBit, node);
    return code_node(0, 1, node);
  }

  Status level(int depth) {
    const Level& parents = tree_.levels[depth - 1];
    Links alone{};
    std::uint32_t index = 0;
    for (std::uint32_t parent = 1; parent <= parents.size(); ++parent) {
      if (links_.used() > gpcc::kMaxLinked) return gpcc::kTooLarge;
      const unsigned siblings = parents.occupancy[parent];
      const Links* links = nullptr;
      std::uint64_t window = 0;
      if (!siblings_only_) {
        links = &parent_links_.of(parent, alone);
        window = parent_links_.has(parent) ? window_of(*links, parents.occupancy.data())
                                           : window_alone(parents.occupancy[parent]);
      }
      for (unsigned rest = siblings; rest != 0; rest &= rest - 1) {
        const int octant = __builtin_ctz(rest);
        ++index;
        NodeContext node;
        if (siblings_only_)
          node.pattern = sibling_pattern(siblings, octant);
        else
          look_around(depth, parent, *links, window, octant, index, node);
        const Status status = code_node(depth, index, node);
        if (status != gpcc::kOk) return status;
      }
    }
    return gpcc::kOk;
  }

  static unsigned sibling_pattern(unsigned siblings, int octant) {
    return (siblings >> (octant ^ 4) & 1) << (octant >> 2 & 1) | (siblings >> (octant ^ 2) & 1) << (octant & 2 ? 2 : 3) |
           (siblings >> (octant ^ 1) & 1) << (octant & 1 ? 4 : 5);
  }

  void look_around(int depth, std::uint32_t parent, const Links& links, std::uint64_t window, int octant,
                   std::uint32_t index, NodeContext& node) {
    const Level& parents = tree_.levels[depth - 1];
    const int shift = window_shift(octant);
    const std::uint64_t code = parent_codes_[parent] << 3 | static_cast<unsigned>(octant);
    codes_[index] = code;
    const std::uint64_t all_around = window >> shift & kAround27;
    if (keep_links_ && all_around != std::uint64_t{1} << kCentreBit)
      link(links, parents, octant, all_around, links_.add(index));
    const std::uint64_t around = bounded_ ? within_cube(all_around, code, settings_.neighbour_boundary) : all_around;
    node.pattern = face_pattern(around);
    if (settings_.depth - depth < settings_.intra_prediction) predict(around, node);
    if (!settings_.adjacent_child) return;
    const std::uint8_t* coded = tree_.levels[depth].occupancy.data();
    if (node.pattern & 2) add_adjacent(coded[node_at(links, parents, 5 + shift)], 0xf0, 4, 2, node);
    if (node.pattern & 4) add_adjacent(coded[node_at(links, parents, 17 + shift)], 0xcc, 2, 4, node);
    if (node.pattern & 16) add_adjacent(coded[node_at(links, parents, 20 + shift)], 0xaa, 1, 16, node);
  }

  Status code_node(int depth, std::uint32_t index, const NodeContext& node) {
    Level& here = tree_.levels[depth];
    const unsigned occupancy = model_.code(coder_, here.occupancy[index], node);
    if constexpr (!Coder::kEncoder) {
      if (coder_.failed()) return gpcc::kTruncated;
      here.occupancy[index] = static_cast<std::uint8_t>(occupancy);
      here.first_child[index] = next_child_;
      if (!leaves_below_) {
        auto& below = tree_.levels[depth + 1].occupancy;
        below.resize(below.size() + __builtin_popcount(occupancy));
        if (below.size() > max_points_ + 1) return gpcc::kCountMismatch;
      }
    }
    next_child_ += __builtin_popcount(occupancy);
    return leaves_below_ ? code_leaves(occupancy) : gpcc::kOk;
  }

  Status code_leaves(unsigned occupancy) {
    const int count = __builtin_popcount(occupancy);
    if (settings_.unique_points) {
      points_ += count;
    } else {
      for (int i = 0; i < count; ++i) {
        const std::uint32_t leaf = next_child_ - count + i;
        const std::uint32_t points =
            model_.code_leaf_points(coder_, Coder::kEncoder ? tree_.weight_of_leaf(leaf) : 0);
        if (!Coder::kEncoder) tree_.leaf_points.push_back(points);
        points_ += points;
      }
    }
    return points_ > max_points_ ? gpcc::kCountMismatch : gpcc::kOk;
  }

  const OctreeSettings settings_;
  Coder& coder_;
  Octree& tree_;
  const std::uint64_t max_points_;
  const bool siblings_only_;
  OccupancyModel model_;
  LinkTable parent_links_, links_;                 // of the level above and of the level being coded
  std::vector<std::uint64_t> parent_codes_, codes_;  // Morton codes, likewise
  std::uint32_t next_child_ = 1;
  std::uint64_t points_ = 0;
  bool keep_links_ = false, bounded_ = false, leaves_below_ = false;
};

}  // namespace
}  // namespace codec

void octree_encode(const gpcc::OctreeSettings& settings, gpcc::Octree& tree,
                   std::vector<std::uint8_t>& out) {
  codec::BinaryEncoder coder(out);
  codec::Walk<codec::BinaryEncoder>(settings, coder, tree, tree.points).run();
  coder.finish();
}

gpcc::Status octree_decode(const gpcc::OctreeSettings& settings, const std::uint8_t* data,
                                     std::size_t size, std::uint64_t points, gpcc::Octree& tree) {
  codec::BinaryDecoder coder(data, size);
  const auto status = codec::Walk<codec::BinaryDecoder>(settings, coder, tree, points).run();
  if (status != gpcc::kOk) return status;
  if (coder.failed()) return gpcc::kTruncated;
  return tree.points == points ? gpcc::kOk : gpcc::kCountMismatch;
}

}  // namespace ggslam::GGSLAM_ISA
