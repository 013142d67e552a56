// SPDX-License-Identifier: Apache-2.0
// What maps of a floor need of a volume: where points were measured, and what is known above each cell.
#include <cmath>

#include "abi/core/volumes.hpp"
#include "common/context.hpp"
#include "common/guard.hpp"
#include "volumes/tsdf.hpp"

using namespace ggslam::volumes;

namespace {

// The block that was looked up last.
struct Reader {
  const Tsdf& map;
  BlockCoordinates at{0, 0, 0};
  const VoxelBlock* voxels = nullptr;
  uint8_t throughout = 0;  // of a block without voxels
  bool valid = false;

  uint8_t read(const int32_t v[3]) {
    const BlockCoordinates wanted{v[0] >> 3, v[1] >> 3, v[2] >> 3};
    if (!valid || wanted.x != at.x || wanted.y != at.y || wanted.z != at.z) {
      const int64_t row = map.find(wanted);
      voxels = row < 0 ? nullptr : map.voxels(map.block(row));
      throughout = row >= 0 && map.block(row).free_weight > 0 ? kSeenBit : 0;
      at = wanted, valid = true;
    }
    if (voxels == nullptr) return throughout;
    const int row = (v[0] & 7) + (v[1] & 7) * kSide + (v[2] & 7) * kSide * kSide;
    if (voxels->weight[row] == 0) return 0;
    return static_cast<uint8_t>(voxels->value[row] < 0 ? kSeenBit | kBehindBit : kSeenBit);
  }
};

// Without a call, as std::floor is one for the plainest processors.
int32_t floor_of(double x) {
  const int32_t whole = static_cast<int32_t>(x);
  return whole - (x < whole);
}

void check(const ColumnGrid& g) {
  for (const int32_t count : {g.layers, g.rows, g.columns}) ggslam::check_range("grid", count, 0, 1 << 24);
  for (const double* part : {g.start, g.layer_step, g.row_step, g.column_step})
    ggslam::check_within("grid", part, 3, 1e9);
  for (int a = 0; a < 3; ++a) {
    const double farthest = std::fabs(g.start[a]) + g.layers * std::fabs(g.layer_step[a]) +
                            g.rows * std::fabs(g.row_step[a]) + g.columns * std::fabs(g.column_step[a]);
    ggslam::check_range("grid", farthest, 0.0, 1e9);
  }
}

}  // namespace

GGSLAM_EXPORT int64_t ggslam_tsdf_octants(void* handle, double* middles) try {
  const Tsdf& map = ggslam::object_of<Tsdf>(handle);
  int64_t n = 0;
  for (std::size_t row = 0; row < map.size(); ++row) {
    const Block& block = map.block(row);
    const PointBlock* points = map.points(block);
    if (points == nullptr) continue;
    for (int v = 0; v < kVoxels; ++v) {
      if (points->hits[v] < kOccupied) continue;
      const ggslam::Vec3i voxel = kSide * vector_of(block.at) + voxel_of(v);
      for (int bits = points->octants[v]; bits != 0; bits &= bits - 1, ++n) {
        const int octant = __builtin_ctz(static_cast<unsigned>(bits));
        if (middles == nullptr) continue;
        for (int a = 0; a < 3; ++a) middles[3 * n + a] = voxel[a] + 0.25 + 0.5 * (octant >> a & 1);
      }
    }
  }
  return n;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_tsdf_columns(void* handle, void* context, const ColumnGrid* grid, uint8_t* seen) try {
  const Tsdf& map = ggslam::object_of<Tsdf>(handle);
  const ColumnGrid& g = ggslam::object_of<ColumnGrid>(grid);
  check(g);
  const std::size_t cells = ggslam::elements(g.rows, g.columns);
  ggslam::check_array("seen", seen, static_cast<int64_t>(ggslam::elements(g.layers, g.rows, g.columns)));
  ggslam::object_of<ggslam::Context>(context).pool.parallel_for(
      static_cast<std::size_t>(g.rows), 4, [&](std::size_t begin, std::size_t end, int) {
        Reader reader{map};
        for (std::size_t row = begin; row < end; ++row)
          for (int column = 0; column < g.columns; ++column)
            for (int layer = 0; layer < g.layers; ++layer) {
              int32_t v[3];
              for (int a = 0; a < 3; ++a)
                v[a] = floor_of(g.start[a] + layer * g.layer_step[a] + static_cast<double>(row) * g.row_step[a] +
                                column * g.column_step[a]);
              seen[layer * cells + row * g.columns + column] = reader.read(v);
            }
      });
  return 0;
} GGSLAM_CATCH_ALL
