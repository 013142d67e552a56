// SPDX-License-Identifier: Apache-2.0
// Prepares the images of a view for the fusion.
#include <algorithm>
#include <limits>

#include "common/kernels/simd.hpp"
#include "volumes/tsdf_fusion.hpp"

namespace ggslam::GGSLAM_ISA {

using volumes::DepthTile;
using volumes::kErosion;
using volumes::kTile;

// Copies row `row` of tiles of the depth image (0 where nothing was measured), with the tiles' ranges and numbers of
// pixels with depth. What lies beyond max_depth (+inf included: the sensor found nothing) is cut off at `farthest`.
void tsdf_prepare_depth(const float* depth, int width, int height, int row, float min_depth, float farthest, float* out,
                        DepthTile* tiles, int32_t* valid) {
  const int first = row * kTile, last = std::min(first + kTile, height), columns = (width + kTile - 1) / kTile;
  for (int c = 0; c < columns; ++c) tiles[c] = {std::numeric_limits<float>::infinity(), 0.0f}, valid[c] = 0;
  for (int v = first; v < last; ++v) {
    const float* from = depth + static_cast<std::size_t>(v) * width;
    float* to = out + static_cast<std::size_t>(v) * width;
    for (int u = 0; u < width; ++u) to[u] = from[u] >= min_depth ? std::min(from[u], farthest) : 0.0f;
    for (int c = 0; c < columns; ++c) {
      const int end = std::min((c + 1) * kTile, width);
      float low = tiles[c].low, high = tiles[c].high;
      int n = valid[c];
      for (int u = c * kTile; u < end; ++u) {
        low = std::min(low, to[u] > 0 ? to[u] : std::numeric_limits<float>::infinity());
        high = std::max(high, to[u]);
        n += to[u] > 0;
      }
      tiles[c] = {low, high}, valid[c] = n;
    }
  }
}

// Smallest depth within kErosion pixels along the rows of the image, in row `v`; infinite where there is none.
void tsdf_erode_row(const float* depth, int width, int v, float* out) {
  const float* from = depth + static_cast<std::size_t>(v) * width;
  float* to = out + static_cast<std::size_t>(v) * width;
  constexpr float kNone = std::numeric_limits<float>::infinity();
  const auto at = [&](int u) { return u >= 0 && u < width && from[u] > 0 ? from[u] : kNone; };
  const auto slow = [&](int u) {
    float low = kNone;
    for (int d = -kErosion; d <= kErosion; ++d) low = std::min(low, at(u + d));
    to[u] = low;
  };
  const int border = std::min(kErosion, width);
  for (int u = 0; u < border; ++u) slow(u);
  for (int u = border; u < width - kErosion; ++u) {
    float low = kNone;
    for (int d = -kErosion; d <= kErosion; ++d) low = std::min(low, from[u + d] > 0 ? from[u + d] : kNone);
    to[u] = low;
  }
  for (int u = std::max(border, width - kErosion); u < width; ++u) slow(u);
}

// The same along the columns, of what `tsdf_erode_row` left.
void tsdf_erode_column(const float* rows, int width, int height, int v, float* out) {
  float* to = out + static_cast<std::size_t>(v) * width;
  const int first = std::max(v - kErosion, 0), last = std::min(v + kErosion, height - 1);
  std::copy_n(rows + static_cast<std::size_t>(first) * width, width, to);
  for (int y = first + 1; y <= last; ++y) {
    const float* from = rows + static_cast<std::size_t>(y) * width;
    for (int u = 0; u < width; ++u) to[u] = std::min(to[u], from[u]);
  }
}

void tsdf_octants_of_row(const volumes::OctantRow& row) {
  constexpr std::int32_t kNone = volumes::OctantRow::kNone;
  static_assert(kLanes <= volumes::OctantRow::kSlack && 64 % kLanes == 0);
  const Float max_depth = broadcast(row.max_depth), one = broadcast(1.0f);
  for (int u = 0; u < row.width; u += kLanes) {
    const Float depth = load(row.depth + u), column = lane_numbers() + static_cast<float>(u);
    const Mask known = both(greater(depth, Float{}), greater_equal(max_depth, depth));
    const Float z = zero_unless(known, depth);
    for (int a = 0; a < 3; ++a) {
      const Float x = row.origin[a] + z * (row.first[a] + column * row.step[a]);
      const Float whole = to_float(truncate(x));
      const Int octant = truncate(whole - zero_unless(greater(whole, x), one));
      store_int(row.out[a] + u, a > 0 ? octant : select_int(known, octant, broadcast_int(kNone)));
    }
  }
  const Int minus = broadcast_int(-1);
  for (int begin = 0; begin < row.width; begin += 64) {
    std::uint64_t word = 0;
    for (int u = begin; u < row.width && u < begin + 64; u += kLanes) {
      Int left{}, above{};
      for (int a = 0; a < 3; ++a) {
        const Int octant = load_int(row.out[a] + u);
        left |= octant ^ load_int(row.out[a] + u - 1), above |= octant ^ load_int(row.above[a] + u);
      }
      left |= -left, above |= -above;  // negative unless zero
      const Mask known = greater_equal_int(load_int(row.out[0] + u), broadcast_int(kNone + 1));
      const Mask differs = both(greater_equal_int(minus, left), greater_equal_int(minus, above));
      word |= static_cast<std::uint64_t>(bits(both(known, differs))) << (u - begin);
    }
    const int rest = row.width - begin;
    row.fresh[begin / 64] = rest < 64 ? word & ((std::uint64_t{1} << rest) - 1) : word;
  }
}

// Red + 256 green + 65536 blue of pixels [begin, end).
void tsdf_pack_color(const uint8_t* color, std::size_t begin, std::size_t end, int32_t* out) {
  for (std::size_t p = begin; p < end; ++p)
    out[p] = color[3 * p] | color[3 * p + 1] << 8 | color[3 * p + 2] << 16;
}

}  // namespace ggslam::GGSLAM_ISA
