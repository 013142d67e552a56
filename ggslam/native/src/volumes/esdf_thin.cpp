// SPDX-License-Identifier: Apache-2.0
// Things that are too thin for the voxels: the signed distance averages them with what is seen beside them, and has no zero
// crossing there. Where points were measured in a voxel and neither it nor a voxel at its faces has a crossing (which a
// surface through the voxel would have), the points are the surface.
#include <algorithm>
#include <cstring>

#include "volumes/esdf.hpp"

namespace ggslam::volumes {
namespace {

constexpr uint64_t kFirstColumn = 0x0101010101010101ull, kLastColumn = kFirstColumn << 7;

// Which of 8 voxels are occupied: the highest bits of their hits.
uint64_t occupied_bits(const uint8_t* hits) {
  static_assert(kOccupied == 128 && kSide == 8);
  uint64_t eight;
  std::memcpy(&eight, hits, sizeof eight);
  return ((eight & 0x8080808080808080ull) >> 7) * 0x0102040810204080ull >> 56;
}

// The mean of the middles of octants, from the voxel's centre.
Site site_of(int voxel, uint8_t octants) {
  Site site{};
  site.voxel = voxel;
  int n = 0;
  for (int o = 0; o < 8; ++o) {
    if (!(octants >> o & 1)) continue;
    ++n;
    for (int a = 0; a < 3; ++a) site.at[a] += o >> a & 1 ? 0.25f : -0.25f;
  }
  const Vec3f place = cast<float>(voxel_of(voxel));
  for (int a = 0; a < 3; ++a) site.at[a] = place[a] + (n > 0 ? site.at[a] / static_cast<float>(n) : 0.0f);
  return site;
}

}  // namespace

// Adds what is thin to the zero crossings of a block. Voxels in which points were measured are known.
void Esdf::add_thin(int32_t row, BlockSites& found) const {
  const BlockCoordinates at = table_.at(row);
  const int64_t held = tsdf_.find(at);
  const PointBlock* points = held < 0 ? nullptr : tsdf_.points(tsdf_.block(held));
  if (points == nullptr) return;
  uint64_t hit[kSide] = {};
  for (int row = 0; row < kSide * kSide; ++row)
    hit[row / kSide] |= occupied_bits(points->hits + row * kSide) << row % kSide * kSide;
  if (std::all_of(hit, hit + kSide, [](uint64_t word) { return word == 0; })) return;
  static constexpr uint64_t kNone[kSide] = {};
  const auto crossed = [&](int x, int y, int z) {
    const int32_t other = table_.find({at.x + x, at.y + y, at.z + z});
    return other < 0 ? kNone : blocks_[other]->crossed;
  };
  const uint64_t *own = blocks_[row]->crossed, *left = crossed(-1, 0, 0), *right = crossed(1, 0, 0),
                 *before = crossed(0, -1, 0), *after = crossed(0, 1, 0);
  const std::size_t crossings = found.sites.size();
  for (int k = 0; k < kSide; ++k) {
    const uint64_t c = own[k];
    uint64_t near = c | (c << 1 & ~kFirstColumn) | (c >> 1 & ~kLastColumn) | c << kSide | c >> kSide;
    near |= (left[k] >> 7 & kFirstColumn) | (right[k] << 7 & kLastColumn) | before[k] >> 56 | after[k] << 56;
    near |= k > 0 ? own[k - 1] : crossed(0, 0, -1)[kSide - 1];
    near |= k + 1 < kSide ? own[k + 1] : crossed(0, 0, 1)[0];
    found.known[k] |= hit[k];
    for (uint64_t thin = hit[k] & ~near; thin != 0; thin &= thin - 1) {
      const int voxel = k * kSide * kSide + __builtin_ctzll(thin);
      found.sites.push_back(site_of(voxel, points->octants[voxel]));
    }
  }
  std::inplace_merge(found.sites.begin(), found.sites.begin() + static_cast<std::ptrdiff_t>(crossings),
                     found.sites.end(), [](const Site& a, const Site& b) { return a.voxel < b.voxel; });
}

}  // namespace ggslam::volumes
