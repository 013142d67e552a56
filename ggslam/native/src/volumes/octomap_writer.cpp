// SPDX-License-Identifier: Apache-2.0
#include <cstring>

#include "volumes/occupancy_files.hpp"
#include "volumes/occupancy_walk.hpp"

namespace ggslam {
namespace {

struct Mark {
  std::size_t position;
  std::uint64_t nodes;
};

// Two bits for each child, the lowest for the first: 0 unknown, 1 free, 2 occupied, 3 inner.
struct BinarySink {
  OctomapText& out;
  float threshold;

  float value(float v) const { return v >= threshold ? 1.0f : 0.0f; }
  Mark open() {
    const Mark mark{out.data.size(), out.nodes++};
    out.data.insert(out.data.end(), 2, 0);
    return mark;
  }
  void leaf(std::uint64_t, int, float) { ++out.nodes; }
  void revoke(const Mark& mark) { out.data.resize(mark.position), out.nodes = mark.nodes; }
  void close(const Mark& mark, const Part child[8], float) {
    unsigned bits = 0;
    for (int i = 0; i < 8; ++i) {
      const unsigned code = child[i].kind == CellKind::unknown ? 0 : child[i].kind == CellKind::node ? 3
                            : child[i].value > 0               ? 2
                                                               : 1;
      bits |= code << (2 * i);
    }
    out.data[mark.position] = static_cast<std::uint8_t>(bits);
    out.data[mark.position + 1] = static_cast<std::uint8_t>(bits >> 8);
  }
};

// Each node: its value (float32) and one bit for each child that exists; an inner node has its children's largest.
struct FullSink {
  OctomapText& out;

  float value(float v) const { return v; }
  Mark open() {
    const Mark mark{out.data.size(), out.nodes++};
    out.data.insert(out.data.end(), 5, 0);
    return mark;
  }
  void leaf(std::uint64_t, int, float v) { put(open().position, v, 0); }
  void revoke(const Mark& mark) { out.data.resize(mark.position), out.nodes = mark.nodes; }
  void close(const Mark& mark, const Part child[8], float largest) {
    unsigned bits = 0;
    for (int i = 0; i < 8; ++i) bits |= (child[i].kind != CellKind::unknown) << i;
    put(mark.position, largest, bits);
  }
  void put(std::size_t position, float v, unsigned bits) {
    std::memcpy(out.data.data() + position, &v, 4);  // little-endian, as every machine that OctoMap runs on
    out.data[position + 4] = static_cast<std::uint8_t>(bits);
  }
};

}  // namespace

OctomapText write_octomap(const OccupancyTree& tree, OctomapFormat format, float threshold) {
  OctomapText out;
  if (format == OctomapFormat::binary) {
    BinarySink sink{out, threshold};
    OccupancyWalk<BinarySink>(tree, sink).run();
  } else {
    FullSink sink{out};
    OccupancyWalk<FullSink>(tree, sink).run();
  }
  return out;
}

}  // namespace ggslam
