// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>
#include <cstring>

#include "volumes/occupancy_files.hpp"

namespace ggslam {
namespace {

// The depth of the recursion is that of the octree, whatever the file says.
class Reader {
 public:
  Reader(OccupancyTree& tree, OctomapFormat format, const std::uint8_t* data, std::size_t size, float free,
         float occupied, std::uint64_t maximum_blocks)
      : tree_(tree), format_(format), data_(data), size_(size), free_(free), occupied_(occupied),
        maximum_blocks_(maximum_blocks) {}

  OctomapReading run() {
    float value = 0;
    std::uint8_t bits = 0;
    if (format_ == OctomapFormat::full) {
      take_full(value, bits);
      tree_.root = bits == 0 ? leaf(value) : read_inner(0, bits);
    } else {
      ++result_.nodes;
      tree_.root = read_inner(0, 0);
    }
    result_.bytes_used = position_;
    return result_;
  }

 private:
  bool good() const { return result_.fault == OctomapFault::none; }
  void fail(OctomapFault fault) {
    if (good()) result_.fault = fault;
  }

  Cell leaf(float value) {
    if (!std::isfinite(value)) fail(OctomapFault::not_finite);
    return {CellKind::leaf, 0, value};
  }

  // Two bits for each child of a binary node.
  unsigned take_binary() {
    if (size_ - position_ < 2) {
      fail(OctomapFault::cut_off);
      return 0;
    }
    const unsigned bits = data_[position_] | data_[position_ + 1] << 8;
    position_ += 2;
    if (bits == 0) fail(OctomapFault::childless);
    return bits;
  }

  void take_full(float& value, std::uint8_t& bits) {
    value = 0, bits = 0;
    if (size_ - position_ < 5) return fail(OctomapFault::cut_off);
    std::memcpy(&value, data_ + position_, 4);
    bits = data_[position_ + 4];
    position_ += 5;
    ++result_.nodes;
  }

  // Goes through the children of the node at `depth`, whose own bits (of a full file) are known: calls
  // visit_leaf(i, value) and visit_inner(i, bits). A binary file lists all kinds first, then the inner ones' contents.
  template <class VisitLeaf, class VisitInner>
  void for_each_child(int depth, std::uint8_t bits, VisitLeaf visit_leaf, VisitInner visit_inner) {
    const bool binary = format_ == OctomapFormat::binary;
    const unsigned kinds = binary ? take_binary() : 0;
    for (int i = 0; i < 8 && good(); ++i) {
      const unsigned kind = kinds >> (2 * i) & 3;
      if (binary ? kind == 0 : (bits >> i & 1) == 0) continue;
      float value = kind == 2 ? occupied_ : free_;
      std::uint8_t child_bits = 0;
      if (binary) ++result_.nodes;
      else take_full(value, child_bits);
      const bool inner = binary ? kind == 3 : child_bits != 0;
      if (inner && depth + 1 == kKeyBits) return fail(OctomapFault::too_deep);
      if (inner) visit_inner(i, child_bits);
      else visit_leaf(i, leaf(value).value);
    }
  }

  Cell read_inner(int depth, std::uint8_t bits) {
    if (depth == kBlockDepth) return read_whole_block(bits);
    Cell child[8];
    for_each_child(depth, bits, [&](int i, float value) { child[i] = {CellKind::leaf, 0, value}; },
                   [&](int i, std::uint8_t child_bits) { child[i] = read_inner(depth + 1, child_bits); });
    return good() ? tree_.make_node(child) : Cell{};
  }

  Cell read_whole_block(std::uint8_t bits) {
    if (tree_.blocks.used() >= maximum_blocks_) {
      fail(OctomapFault::too_large);
      return {};
    }
    OccupancyBlock block = {};
    read_block(block, 0, kBlockDepth, bits);
    return good() ? tree_.make_block(block) : Cell{};
  }

  void read_block(OccupancyBlock& block, int first, int depth, std::uint8_t bits) {
    const int voxels = 1 << (3 * (kKeyBits - 1 - depth));
    const auto fill = [&](int i, float value) {
      const int begin = first + i * voxels;
      std::fill_n(block.value + begin, voxels, value);
      block.known[begin / 64] |= (voxels == 64 ? ~std::uint64_t{0} : (std::uint64_t{1} << voxels) - 1) << (begin % 64);
    };
    for_each_child(depth, bits, fill, [&](int i, std::uint8_t child_bits) {
      read_block(block, first + i * voxels, depth + 1, child_bits);
    });
  }

  OccupancyTree& tree_;
  OctomapFormat format_;
  const std::uint8_t* data_;
  std::size_t size_, position_ = 0;
  float free_, occupied_;
  std::uint64_t maximum_blocks_;
  OctomapReading result_;
};

}  // namespace

OctomapReading read_octomap(OccupancyTree& tree, OctomapFormat format, const std::uint8_t* data, std::size_t size,
                            float free, float occupied, std::uint64_t maximum_blocks) {
  tree.clear();
  const OctomapReading result = Reader(tree, format, data, size, free, occupied, maximum_blocks).run();
  if (result.fault != OctomapFault::none) tree.clear();
  return result;
}

}  // namespace ggslam
