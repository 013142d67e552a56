// SPDX-License-Identifier: Apache-2.0
// Distances and gradients at points, interpolated between voxels.
#include <cmath>
#include <limits>

#include "volumes/esdf_types.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

using namespace ggslam::volumes;

struct Sample {
  float distance, gradient[3];
};

void unpack(uint32_t bits, float g[3]) {
  for (int a = 0; a < 3; ++a) g[a] = static_cast<float>(static_cast<int>(bits >> (10 * a) & 1023u) - 511) / 511.0f;
}

// The blocks that were looked up last.
struct Reader {
  const QueryInput& in;
  BlockCoordinates at{0, 0, 0};
  const FieldVoxels* block = nullptr;
  bool valid = false, stale = false, read_stale = false;  // read_stale: of any voxel read

  // The distance of a voxel; NaN if it is not known.
  float distance(int x, int y, int z) {
    go_to({x >> 3, y >> 3, z >> 3});
    read_stale |= stale;
    return block == nullptr ? std::numeric_limits<float>::quiet_NaN() : block->distance[row_of(x, y, z)];
  }

  bool read(const int v[3], Sample& out) {
    out.distance = distance(v[0], v[1], v[2]);
    if (out.distance != out.distance) return false;
    unpack(block->gradient[row_of(v[0], v[1], v[2])], out.gradient);
    return true;
  }

 private:
  static int row_of(int x, int y, int z) { return (x & 7) + (y & 7) * kSide + (z & 7) * kSide * kSide; }

  void go_to(BlockCoordinates wanted) {
    if (!valid || wanted.x != at.x || wanted.y != at.y || wanted.z != at.z) {
      const int32_t row = block_row(in.table, wanted);
      block = row < 0 ? nullptr : in.voxels[row];
      stale = row >= 0 && in.stale[row];
      at = wanted, valid = true;
    }
  }
};

// At `place`, in voxels, centres at whole numbers. The gradient is that of the interpolated distance, from a voxel before to
// a voxel behind along each axis: single discs stand out or back at edges, and turn what is measured from one of them.
// Voxels that are unknown are extrapolated from `home`, the voxel that the point is in.
void interpolate(Reader& reader, const double place[3], const int home[3], const Sample& centre, float voxel,
                 Sample& out) {
  int low[3];
  float t[3];
  for (int a = 0; a < 3; ++a) {
    const double below = std::floor(place[a]);
    low[a] = static_cast<int>(below), t[a] = static_cast<float>(place[a] - below);
  }
  const auto distance_at = [&](int x, int y, int z) {
    float distance = reader.distance(x, y, z);
    if (distance != distance)
      distance = centre.distance + voxel * (centre.gradient[0] * static_cast<float>(x - home[0]) +
                                            centre.gradient[1] * static_cast<float>(y - home[1]) +
                                            centre.gradient[2] * static_cast<float>(z - home[2]));
    return distance;
  };
  // Those of the corners around the place (1 and 2 along each axis) and of their neighbours along the axes.
  float near[4][4][4];
  for (int k = 0; k < 4; ++k)
    for (int j = 0; j < 4; ++j) {
      const bool outside = k % 3 == 0, both = outside && j % 3 == 0;
      if (both) continue;
      const bool ends = !outside && j % 3 != 0;
      for (int i = ends ? 0 : 1; i < (ends ? 4 : 3); ++i)
        near[k][j][i] = distance_at(low[0] + i - 1, low[1] + j - 1, low[2] + k - 1);
    }
  out = Sample{};
  for (int k = 1; k < 3; ++k)
    for (int j = 1; j < 3; ++j)
      for (int i = 1; i < 3; ++i) {
        const float weight = (i == 2 ? t[0] : 1 - t[0]) * (j == 2 ? t[1] : 1 - t[1]) * (k == 2 ? t[2] : 1 - t[2]);
        out.distance += weight * near[k][j][i];
        out.gradient[0] += weight * (near[k][j][i + 1] - near[k][j][i - 1]);
        out.gradient[1] += weight * (near[k][j + 1][i] - near[k][j - 1][i]);
        out.gradient[2] += weight * (near[k + 1][j][i] - near[k - 1][j][i]);
      }
  for (int a = 0; a < 3; ++a) out.gradient[a] /= 2 * voxel;
}

}  // namespace

// Points begin ... end - 1: distance [n] in metres, gradient [n, 3], known [n], stale [n]. A point is known if the voxel
// that it is in is, and stale if one of those is that it is interpolated between.
void esdf_query(const QueryInput& in, std::size_t begin, std::size_t end, float* distance, float* gradient,
                uint8_t* known, uint8_t* stale) {
  Reader reader{in};
  const double most = std::numeric_limits<int>::max() / 2;
  for (std::size_t n = begin; n < end; ++n) {
    double place[3];
    int home[3];
    bool finite = true;
    for (int a = 0; a < 3; ++a) {
      place[a] = in.points[3 * n + a] / in.voxel - 0.5;
      finite = finite && place[a] > -most && place[a] < most;
      home[a] = finite ? static_cast<int>(std::floor(place[a] + 0.5)) : 0;
    }
    Sample centre, out{std::numeric_limits<float>::quiet_NaN(), {0, 0, 0}};
    reader.read_stale = false;
    known[n] = finite && reader.read(home, centre);
    if (known[n]) interpolate(reader, place, home, centre, in.voxel, out);
    stale[n] = known[n] && reader.read_stale;
    distance[n] = out.distance;
    float square = 0;
    for (int a = 0; a < 3; ++a) square += out.gradient[a] * out.gradient[a];
    const float scale = square > 1e-4f ? 1 / std::sqrt(square) : 0.0f;
    for (int a = 0; a < 3; ++a) gradient[3 * n + a] = scale * out.gradient[a];
  }
}

}  // namespace ggslam::GGSLAM_ISA
