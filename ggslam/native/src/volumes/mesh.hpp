// SPDX-License-Identifier: Apache-2.0
// The zero level of a TSDF as a mesh of triangles whose vertices are shared.
#pragma once
#include <cstdint>
#include <vector>

#include "abi/core/volumes.hpp"
#include "volumes/surface_cells.hpp"

namespace ggslam::volumes {

// Vertices of a block: one for each edge of the voxel grid that the surface cuts, of the lower voxel's block.
struct BlockVertices {
  BlockBits used[3];            // by the axis of the edge
  uint16_t before[3 * kSide];   // vertices in the words before
  int64_t first = 0;            // number of the block's first vertex

  int64_t number(int axis, int i, int j, int k) const {
    const uint64_t below = (1ull << (i + 8 * j)) - 1;
    return first + before[8 * axis + k] + __builtin_popcountll(used[axis].word[k] & below);
  }
};

// A layer of cells (bits), and the same moved so that each voxel finds its lower neighbour's along x, y or both.
struct LowerCells {
  uint64_t here, x, y, xy;
};

class Mesher {
 public:
  Mesher(ThreadPool& pool, const SurfaceCells& cells);

  int64_t vertices() const { return vertices_; }
  int64_t triangles() const { return triangles_; }
  void write(ThreadPool& pool, const MeshArrays& out) const;

 private:
  const SurfaceCells& cells_;
  std::vector<BlockVertices> blocks_;
  std::vector<int64_t> first_triangle_;
  int64_t vertices_ = 0, triangles_ = 0;

  LowerCells lower_cells(const SurfaceBlock& block, int k) const;
  void find_vertices(std::size_t n);
  void write_vertices(std::size_t n, const MeshArrays& out) const;
  void write_triangles(std::size_t n, int32_t* out) const;
};

}  // namespace ggslam::volumes
