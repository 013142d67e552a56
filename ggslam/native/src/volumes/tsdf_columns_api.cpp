// SPDX-License-Identifier: Apache-2.0
// What maps of a floor need of a volume: where points were measured, and what is known above each cell.
#include <algorithm>
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

// How many steps from a place stay in the block that voxel v, which the place is in, belongs to; rather one too few.
int steps_within(const double place[3], const int32_t v[3], const double step[3], int most) {
  double steps = most;
  for (int a = 0; a < 3; ++a) {
    if (step[a] == 0) continue;
    const double low = (v[a] >> 3) * kSide, end = step[a] > 0 ? low + kSide : low;
    steps = std::min(steps, (end - place[a]) / step[a] - 1e-6);
  }
  return std::max(0, static_cast<int>(steps));
}

// What the voxels of a column are, layer by layer; `seen` has a byte for each, `stride` apart.
void read_column(Reader& reader, const double foot[3], const double step[3], int layers, uint8_t* seen,
                 std::size_t stride) {
  for (int layer = 0; layer < layers; ++layer) {
    double place[3];
    int32_t v[3];
    for (int a = 0; a < 3; ++a) place[a] = foot[a] + layer * step[a], v[a] = floor_of(place[a]);
    const uint8_t found = reader.read(v);
    seen[layer * stride] = found;
    if (reader.voxels != nullptr) continue;
    for (int left = steps_within(place, v, step, layers - 1 - layer); left > 0; --left)
      seen[++layer * stride] = found;
  }
}

void check(const ColumnGrid& g) {
  for (const int32_t count : {g.layers, g.rows, g.columns, g.first_row, g.first_column})
    ggslam::check_range("grid", count, 0, 1 << 24);
  for (const double* part : {g.start, g.layer_step, g.row_step, g.column_step})
    ggslam::check_within("grid", part, 3, 1e9);
  for (int a = 0; a < 3; ++a) {
    const double farthest = std::fabs(g.start[a]) + g.layers * std::fabs(g.layer_step[a]) +
                            (g.first_row + g.rows) * std::fabs(g.row_step[a]) +
                            (g.first_column + g.columns) * std::fabs(g.column_step[a]);
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
          for (int column = 0; column < g.columns; ++column) {
            double foot[3];
            for (int a = 0; a < 3; ++a)
              foot[a] = g.start[a] + static_cast<double>(g.first_row + row) * g.row_step[a] +
                        (g.first_column + column) * g.column_step[a];
            read_column(reader, foot, g.layer_step, g.layers, seen + row * g.columns + column, cells);
          }
      });
  return 0;
} GGSLAM_CATCH_ALL
