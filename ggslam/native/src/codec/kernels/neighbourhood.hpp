// SPDX-License-Identifier: Apache-2.0
// Neighbours of octree nodes without searching: a node's neighbours are children of its parent's neighbours. The 27
// nodes around a parent (its links) give, by their occupancy bytes, a window of 4 x 4 x 4 bits around its children.
#pragma once
#include <array>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

#include "codec/gpcc.hpp"

namespace ggslam::GGSLAM_ISA::codec {

using gpcc::Level;

// A window has a bit for each (x, y, z) in [0, 4)^3 at x 16 + y 4 + z; the parent's own children are in the middle.
// The 3 x 3 x 3 nodes around child (cx, cy, cz) are the window shifted down by cx 16 + cy 4 + cz ("around"), then the
// child itself is at bit 21.
inline constexpr std::uint64_t kAround27 = 0x0000077707770777;
inline constexpr std::uint64_t kAround19 = kAround27 & ~0x0000050500000505ull;  // without the corners
inline constexpr int kCentreBit = 21;

inline constexpr int window_shift(int octant) { return (octant >> 2) * 16 + (octant >> 1 & 1) * 4 + (octant & 1); }

// Direction (dx + 1) 9 + (dy + 1) 3 + dz + 1.
inline constexpr int kCentre = 13;

struct WindowTables {
  std::uint8_t direction[64];  // of the parent's neighbour that a window position lies in
  std::uint8_t octant[64];     // and its child there
  std::uint8_t around_direction[64];  // direction of a bit of an "around" mask
  std::uint32_t spread[256];   // occupancy byte to the 2 x 2 x 2 bits at (0, 0, 0) of a window
};

constexpr WindowTables make_window_tables() {
  WindowTables t{};
  for (int x = 0; x < 4; ++x)
    for (int y = 0; y < 4; ++y)
      for (int z = 0; z < 4; ++z) {
        const int at = x * 16 + y * 4 + z;
        const int dx = x == 0 ? 0 : x == 3 ? 2 : 1, dy = y == 0 ? 0 : y == 3 ? 2 : 1, dz = z == 0 ? 0 : z == 3 ? 2 : 1;
        t.direction[at] = static_cast<std::uint8_t>(dx * 9 + dy * 3 + dz);
        t.octant[at] = static_cast<std::uint8_t>(((x + 1) & 1) << 2 | ((y + 1) & 1) << 1 | ((z + 1) & 1));
        t.around_direction[at] = static_cast<std::uint8_t>(x < 3 && y < 3 && z < 3 ? x * 9 + y * 3 + z : 0);
      }
  for (int o = 0; o < 256; ++o)
    for (int i = 0; i < 8; ++i)
      if (o >> i & 1) t.spread[o] |= std::uint32_t{1} << window_shift(i);
  return t;
}
inline constexpr WindowTables kWindow = make_window_tables();

// Indices of the nodes around a node, in its own level; 0: there is none.
struct Links {
  std::uint32_t node[27];
};

// Links of the nodes of one level. Most nodes of a sparse cloud have no neighbour: they share none of the memory.
class LinkTable {
 public:
  void clear(std::uint32_t nodes) {
    slot_.assign(nodes + 1, 0);
    used_ = 0;
  }
  bool has(std::uint32_t node) const { return slot_[node] != 0; }
  std::uint32_t used() const { return used_; }
  // Links of a node; `alone` is filled in and returned if none were stored.
  const Links& of(std::uint32_t node, Links& alone) const {
    if (slot_[node] != 0) return at(slot_[node] - 1);
    alone.node[kCentre] = node;
    return alone;
  }
  Links& add(std::uint32_t node) {
    if (used_ == chunks_.size() * kChunk) chunks_.emplace_back(new Links[kChunk]);
    slot_[node] = ++used_;
    return at(used_ - 1);
  }

 private:
  static constexpr std::uint32_t kChunk = 1024;
  Links& at(std::uint32_t i) const { return chunks_[i / kChunk][i % kChunk]; }
  std::vector<std::unique_ptr<Links[]>> chunks_;
  std::vector<std::uint32_t> slot_;
  std::uint32_t used_ = 0;
};

template <int Direction>
inline std::uint64_t window_part(const Links& links, const std::uint8_t* occupancy) {
  constexpr int dx = Direction / 9 - 1, dy = Direction / 3 % 3 - 1, dz = Direction % 3 - 1;
  // Of a neighbour on the low side only the children on its high side touch, and the other way round.
  constexpr std::uint32_t keep = (dx < 0 ? 0x00330000u : dx > 0 ? 0x00000033u : 0x00330033u) &
                                 (dy < 0 ? 0x00300030u : dy > 0 ? 0x00030003u : 0x00330033u) &
                                 (dz < 0 ? 0x00220022u : dz > 0 ? 0x00110011u : 0x00330033u);
  constexpr int shift = (1 + 2 * dx) * 16 + (1 + 2 * dy) * 4 + (1 + 2 * dz);
  const std::uint64_t part = kWindow.spread[occupancy[links.node[Direction]]] & keep;
  if constexpr (shift >= 0)
    return part << shift;
  else
    return part >> -shift;
}

template <std::size_t... Direction>
inline std::uint64_t window_of(const Links& links, const std::uint8_t* occupancy, std::index_sequence<Direction...>) {
  return (window_part<static_cast<int>(Direction)>(links, occupancy) | ...);
}

inline std::uint64_t window_of(const Links& links, const std::uint8_t* occupancy) {
  return window_of(links, occupancy, std::make_index_sequence<27>{});
}

inline std::uint64_t window_alone(std::uint8_t occupancy) {
  return static_cast<std::uint64_t>(kWindow.spread[occupancy]) << kCentreBit;
}

// Index, in the children's level, of the node at a window position whose bit is set.
inline std::uint32_t node_at(const Links& parent_links, const Level& parents, int window_position) {
  const std::uint32_t parent = parent_links.node[kWindow.direction[window_position]];
  const unsigned below = (1u << kWindow.octant[window_position]) - 1;
  return parents.first_child[parent] + __builtin_popcount(parents.occupancy[parent] & below);
}

// Links of the child at `octant` to the nodes whose bits are set in `around`.
inline void link(const Links& parent_links, const Level& parents, int octant, std::uint64_t around, Links& out) {
  out = Links{};
  const int shift = window_shift(octant);
  for (std::uint64_t rest = around; rest != 0; rest &= rest - 1) {
    const int bit = __builtin_ctzll(rest);
    out.node[kWindow.around_direction[bit]] = node_at(parent_links, parents, bit + shift);
  }
}

}  // namespace ggslam::GGSLAM_ISA::codec
