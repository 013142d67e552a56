// SPDX-License-Identifier: Apache-2.0
// Finds the blocks that a view tells about, from large cubes to single blocks, see native/formulas/block_sight.hpp.
#include <algorithm>
#include <cmath>

#include "common/guard.hpp"
#include "volumes/tsdf_candidates.hpp"

namespace ggslam::volumes {

using namespace plain;

namespace {

// The corners of what is in view must have coordinates.
void check_extent(const Vec3d& low, const Vec3d& high, double block) {
  const double most = block * kFarthestBlock;
  for (int a = 0; a < 3; ++a)
    if (!(low[a] > -most && high[a] < most))
      refuse("view: expected one within %g m of the origin, found %g to %g m along axis %d", most, low[a], high[a], a);
}

}  // namespace

void CandidateCount::refuse_view(std::size_t most, const char* what) {
  refuse("view: it shows more than %zu %s: the camera, the range of depth and the voxel do not go together", most, what);
}

CandidateSearch::CandidateSearch(const Tsdf& map, const FusionInput& input, const FusionSettings& settings,
                                 const FusionImages& images)
    : map_(map), in_(input), settings_(settings), images_(images),
      camera_(block_camera(input.width, input.height, input.fx, input.fy, input.cx, input.cy, input.rotation,
                           input.translation, static_cast<double>(map.voxel) * kSide)) {
  camera_.truncation = map.truncation, camera_.max_depth = settings.max_depth;
  Vec3d low, high;
  seen_box(camera_, std::min(images.farthest, settings.max_depth) + map.truncation, low.v, high.v);
  check_extent(low, high, camera_.block);
  do {
    cell_ *= 2;
    first_ = floor(low / (cell_ * camera_.block));
    count_ = floor(high / (cell_ * camera_.block)) - first_ + Vec3i::all(1);
  } while (static_cast<double>(count_[0]) * count_[1] * count_[2] > kMostCells);
}

void CandidateSearch::search(std::size_t cell, CandidateCount& count, std::vector<Candidate>& out) const {
  const int32_t n = static_cast<int32_t>(cell);
  const int32_t x = first_[0] + n % count_[0], y = first_[1] + n / count_[0] % count_[1],
                z = first_[2] + n / count_[0] / count_[1];
  descend({x * cell_, y * cell_, z * cell_}, cell_, count, out);
}

void CandidateSearch::descend(BlockCoordinates at, int side, CandidateCount& count,
                              std::vector<Candidate>& out) const {
  if (!wanted(at, side)) return;
  const SeenCube cube = this->cube(at, side);
  Footprint area;
  if (!footprint_of(camera_, cube, side, area)) return;
  const int top = static_cast<int>(images_.pyramid.levels.size()) - 1;
  // The coarsest tiles of which the footprint meets few.
  int level = 0;
  while (level < top && std::max(area.u1 - area.u0, area.v1 - area.v0) >> level > 2) ++level;
  unsigned seen = 0;
  for (int v = area.v0 >> level; v <= area.v1 >> level && !(seen & kSeenAt); ++v)
    for (int u = area.u0 >> level; u <= area.u1 >> level && !(seen & kSeenAt); ++u)
      seen |= look(level, u, v, area, cube);
  if ((seen & (kSeenAt | kSeenBehind | kSeenPassed)) == 0) return;  // no depth, or hidden
  const bool beyond = (seen & kSeenPassed) != 0 || cube.far > settings_.max_depth;
  const bool is_free = seen == kSeenBehind && area.whole && !beyond;
  if (side == 1) {
    const bool enough = is_free && valid_share(area) >= settings_.free_share;
    const Sight sight = seen & kSeenAt ? Sight::surface
                        : enough   ? Sight::free
                        : beyond   ? Sight::passed
                                   : Sight::partial;
    return emit(at, sight, count, out);
  }
  if (is_free && valid_share(area) == 1.0f) return emit_free(at, side, count, out);
  const int half = side / 2;
  for (int child = 0; child < 8; ++child)
    descend({at.x + half * (child & 1), at.y + half * (child >> 1 & 1), at.z + half * (child >> 2)}, half, count, out);
}

bool CandidateSearch::wanted(BlockCoordinates at, int side) const {
  if (settings_.bounded == 0) return true;
  const int32_t first[3] = {at.x, at.y, at.z};
  for (int a = 0; a < 3; ++a)
    if (first[a] >= settings_.high[a] || first[a] + side <= settings_.low[a]) return false;
  return true;
}

void CandidateSearch::emit(BlockCoordinates at, Sight sight, CandidateCount& count, std::vector<Candidate>& out) const {
  if (!wanted(at, 1)) return;
  const auto row = static_cast<int32_t>(map_.find(at));
  if (sight == Sight::passed && (row < 0 || map_.block(row).slot < 0)) return;  // nothing there to be freed
  count.add(1, sight == Sight::surface || (sight == Sight::partial && row < 0));
  out.push_back({at, sight, cube(at, 1).centre[2], row});
}

void CandidateSearch::emit_free(BlockCoordinates at, int side, CandidateCount& count,
                                std::vector<Candidate>& out) const {
  for (int z = 0; z < side; ++z)
    for (int y = 0; y < side; ++y)
      for (int x = 0; x < side; ++x) emit({at.x + x, at.y + y, at.z + z}, Sight::free, count, out);
}

// What tile (u, v) of a level shows, as far as it belongs to the footprint.
unsigned CandidateSearch::look(int level, int u, int v, const Footprint& area, const SeenCube& cube) const {
  const DepthPyramid::Level& l = images_.pyramid.levels[level];
  const DepthTile tile = l.tiles[static_cast<std::size_t>(v) * l.width + u];
  float low, high;
  bool closer;
  const unsigned shows = tile_shows(camera_, level, u, v, tile.low, tile.high, cube, closer, low, high);
  if (!closer) return shows;
  if (level == 0) return look_at_pixels(u, v, low, high);
  const int u0 = std::max(2 * u, area.u0 >> (level - 1)), u1 = std::min(2 * u + 1, area.u1 >> (level - 1));
  const int v0 = std::max(2 * v, area.v0 >> (level - 1)), v1 = std::min(2 * v + 1, area.v1 >> (level - 1));
  unsigned seen = 0;
  for (int y = v0; y <= v1 && !(seen & kSeenAt); ++y)
    for (int x = u0; x <= u1 && !(seen & kSeenAt); ++x) seen |= look(level - 1, x, y, area, cube);
  return seen;
}

// The same for a tile that has depth in front and behind (a silhouette has nothing between), or beyond the range.
unsigned CandidateSearch::look_at_pixels(int u, int v, float low, float high) const {
  const int u1 = std::min((u + 1) * kTile, in_.width), v1 = std::min((v + 1) * kTile, in_.height);
  unsigned seen = 0;
  for (int y = v * kTile; y < v1; ++y)
    for (int x = u * kTile; x < u1; ++x)
      seen |= pixel_shows(camera_, images_.depth[static_cast<std::size_t>(y) * in_.width + x], low, high);
  return seen;
}

float CandidateSearch::valid_share(const Footprint& a) const {
  const std::size_t stride = images_.pyramid.levels[0].width + 1;
  const int32_t* sums = images_.pyramid.valid.data();
  const int32_t* top = sums + a.v0 * stride;
  const int32_t* bottom = sums + (a.v1 + 1) * stride;
  const int columns = std::min((a.u1 + 1) * kTile, in_.width) - a.u0 * kTile;
  const int rows = std::min((a.v1 + 1) * kTile, in_.height) - a.v0 * kTile;
  const int n = bottom[a.u1 + 1] - bottom[a.u0] - top[a.u1 + 1] + top[a.u0];
  return static_cast<float>(n) / (static_cast<float>(columns) * rows);
}

}  // namespace ggslam::volumes
