// SPDX-License-Identifier: Apache-2.0
#include "volumes/mesh.hpp"

#include "volumes/cube_cases.hpp"
#include "volumes/edge_vertex.hpp"

namespace ggslam::volumes {
namespace {

constexpr std::size_t kChunkOfBlocks = 32;
constexpr uint64_t kFirstColumn = 0x0101010101010101ull;

// Cases of a block's cells, layer by layer: calls f(i, j, k, case).
template <class F>
void for_each_cell(const SurfaceBlock& block, const F& f) {
  for (int k = 0; k < kSide; ++k) {
    uint64_t left = block.cells.word[k];
    if (left == 0) continue;
    const LayerBits low = SurfaceCells::layer(block, k, &BlockSigns::inside);
    const LayerBits high = SurfaceCells::layer(block, k + 1, &BlockSigns::inside);
    for (; left != 0; left &= left - 1) {
      const int bit = __builtin_ctzll(left);
      int number = 0;
      for (int c = 0; c < 4; ++c)
        number |= ((low.corner[c] >> bit) & 1) << c | ((high.corner[c] >> bit) & 1) << (c + 4);
      f(bit & 7, bit >> 3, k, number);
    }
  }
}

// Each voxel's lower neighbour along x or y, given the layer and that of the block before.
uint64_t previous_x(uint64_t here, uint64_t before) {
  return ((here << 1) & ~kFirstColumn) | ((before >> 7) & kFirstColumn);
}
uint64_t previous_y(uint64_t here, uint64_t before) { return here << 8 | before >> 56; }

}  // namespace

// Layer k >= -1 of a block's cells.
LowerCells Mesher::lower_cells(const SurfaceBlock& block, int k) const {
  const auto cells = [&](int x, int y) -> uint64_t {
    const int32_t at = block.around[around_index(x, y, k < 0 ? -1 : 0)];
    return at < 0 ? 0 : cells_.blocks[at].cells.word[k & 7];
  };
  const uint64_t here = cells(0, 0), left = cells(-1, 0);
  const uint64_t y = previous_y(here, cells(0, -1));
  return {here, previous_x(here, left), y, previous_x(y, previous_y(left, cells(-1, -1)))};
}

// Marks the cut edges that some cell of this block or of one below it uses, and counts triangles.
void Mesher::find_vertices(std::size_t n) {
  const SurfaceBlock& block = cells_.blocks[n];
  BlockVertices& out = blocks_[n];
  LayerBits inside = SurfaceCells::layer(block, 0, &BlockSigns::inside);
  LowerCells below = lower_cells(block, -1);
  for (int k = 0; k < kSide; ++k) {
    const LayerBits above = SurfaceCells::layer(block, k + 1, &BlockSigns::inside);
    const LowerCells now = lower_cells(block, k);
    const uint64_t h = inside.corner[0];
    out.used[0].word[k] = (h ^ inside.corner[1]) & (now.here | now.y | below.here | below.y);
    out.used[1].word[k] = (h ^ inside.corner[2]) & (now.here | now.x | below.here | below.x);
    out.used[2].word[k] = (h ^ above.corner[0]) & (now.here | now.x | now.y | now.xy);
    inside = above, below = now;
  }
  int count = 0;
  for (int axis = 0; axis < 3; ++axis)
    for (int k = 0; k < kSide; ++k) {
      out.before[8 * axis + k] = static_cast<uint16_t>(count);
      count += __builtin_popcountll(out.used[axis].word[k]);
    }
  out.first = count;
  int64_t triangles = 0;
  const CubeCases& cases = CubeCases::instance();
  for_each_cell(block, [&](int, int, int, int number) { triangles += cases.triangles(number); });
  first_triangle_[n] = triangles;
}

Mesher::Mesher(ThreadPool& pool, const SurfaceCells& cells)
    : cells_(cells), blocks_(cells.blocks.size()), first_triangle_(cells.blocks.size()) {
  pool.parallel_for(blocks_.size(), kChunkOfBlocks, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t n = begin; n < end; ++n) find_vertices(n);
  });
  for (std::size_t n = 0; n < blocks_.size(); ++n) {
    const int64_t vertices = blocks_[n].first, triangles = first_triangle_[n];
    blocks_[n].first = vertices_, first_triangle_[n] = triangles_;
    vertices_ += vertices, triangles_ += triangles;
  }
}

void Mesher::write(ThreadPool& pool, const MeshArrays& out) const {
  pool.parallel_for(blocks_.size(), kChunkOfBlocks, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t n = begin; n < end; ++n) {
      write_vertices(n, out);
      write_triangles(n, out.triangles);
    }
  });
}

void Mesher::write_vertices(std::size_t n, const MeshArrays& out) const {
  int64_t row = blocks_[n].first;
  for (int axis = 0; axis < 3; ++axis)
    for (int k = 0; k < kSide; ++k)
      for (uint64_t left = blocks_[n].used[axis].word[k]; left != 0; left &= left - 1, ++row) {
        const int bit = __builtin_ctzll(left);
        const EdgeVertex v(cells_.blocks[n], cells_.min_weight, axis, bit & 7, bit >> 3, k);
        v.position(cells_.map.voxel, out.vertices + 3 * row);
        v.normal(out.normals + 3 * row);
        v.color(out.colors + 3 * row);
        out.labels[row] = v.label();
      }
}

void Mesher::write_triangles(std::size_t n, int32_t* out) const {
  const CubeCases& cases = CubeCases::instance();
  const SurfaceBlock& block = cells_.blocks[n];
  const BlockVertices* upper[kSide];
  for (int c = 0; c < kSide; ++c) {
    const int32_t at = block.around[around_index(c & 1, (c >> 1) & 1, c >> 2)];
    upper[c] = at < 0 ? nullptr : &blocks_[at];
  }
  out += 3 * first_triangle_[n];
  for_each_cell(block, [&](int i, int j, int k, int number) {
    const uint8_t* edge = cases.begin(number);
    for (int corner = 0; corner < 3 * cases.triangles(number); ++corner) {
      const CubeEdge e = cases.edges[edge[corner]];
      const int x = i + e.x, y = j + e.y, z = k + e.z;
      const BlockVertices& owner = *upper[(x >> 3) + 2 * (y >> 3) + 4 * (z >> 3)];
      *out++ = static_cast<int32_t>(owner.number(e.axis, x & 7, y & 7, z & 7));
    }
  });
}

}  // namespace ggslam::volumes
