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
  bool valid = false, stale = false;

  bool read(const int v[3], Sample& out) {
    const BlockCoordinates wanted{v[0] >> 3, v[1] >> 3, v[2] >> 3};
    if (!valid || wanted.x != at.x || wanted.y != at.y || wanted.z != at.z) {
      const int32_t row = block_row(in.table, wanted);
      block = row < 0 ? nullptr : in.voxels[row];
      stale = row >= 0 && in.stale[row];
      at = wanted, valid = true;
    }
    if (block == nullptr) return false;
    const int row = (v[0] & 7) + (v[1] & 7) * kSide + (v[2] & 7) * kSide * kSide;
    out.distance = block->distance[row];
    if (out.distance != out.distance) return false;
    unpack(block->gradient[row], out.gradient);
    return true;
  }
};

// At `place`, in voxels, centres at whole numbers. Corners that are unknown are extrapolated from `home`, the voxel
// that the point is in.
void interpolate(Reader& reader, const double place[3], const int home[3], const Sample& centre, float voxel,
                 Sample& out) {
  int low[3];
  float t[3];
  for (int a = 0; a < 3; ++a) {
    const double below = std::floor(place[a]);
    low[a] = static_cast<int>(below), t[a] = static_cast<float>(place[a] - below);
  }
  out = Sample{};
  for (int corner = 0; corner < 8; ++corner) {
    float weight = 1;
    int v[3];
    for (int a = 0; a < 3; ++a) {
      const int up = corner >> a & 1;
      v[a] = low[a] + up;
      weight *= up ? t[a] : 1 - t[a];
    }
    Sample s;
    if (!reader.read(v, s)) {
      s = centre;
      for (int a = 0; a < 3; ++a) s.distance += centre.gradient[a] * voxel * static_cast<float>(v[a] - home[a]);
    }
    out.distance += weight * s.distance;
    for (int a = 0; a < 3; ++a) out.gradient[a] += weight * s.gradient[a];
  }
}

}  // namespace

// Points begin ... end - 1: distance [n] in metres, gradient [n, 3], known [n], stale [n]. A point is known, or stale,
// if the voxel that it is in is.
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
    known[n] = finite && reader.read(home, centre);
    stale[n] = known[n] && reader.stale;
    if (known[n]) interpolate(reader, place, home, centre, in.voxel, out);
    distance[n] = out.distance;
    float square = 0;
    for (int a = 0; a < 3; ++a) square += out.gradient[a] * out.gradient[a];
    const float scale = square > 1e-4f ? 1 / std::sqrt(square) : 0.0f;
    for (int a = 0; a < 3; ++a) gradient[3 * n + a] = scale * out.gradient[a];
  }
}

}  // namespace ggslam::GGSLAM_ISA
