// SPDX-License-Identifier: Apache-2.0
// Finds the blocks that a view tells about, from large cubes to single blocks. A cube is compared with the depth in its
// footprint (the pixels on which the box that encloses it along the camera's axes falls, rounded out to whole tiles)
// tile by tile: over the stretch of depth that the rays through the tile have in common with the cube.
#include <algorithm>
#include <cmath>

#include "common/guard.hpp"
#include "volumes/tsdf_fusion.hpp"

namespace ggslam::volumes {
namespace {

// What a cube's footprint shows, bits: depth behind it, in front of it, at it (each by more or less than the
// truncation), or depth at it that is beyond the range. Once there is depth at it, the others are no longer looked for.
enum : unsigned { kBehind = 1, kInFront = 2, kAt = 4, kPassed = 8 };

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
    : map_(map), in_(input), settings_(settings), images_(images), block_(static_cast<double>(map.voxel) * kSide),
      rotation_(Mat3d::from(input.rotation)), translation_(Vec3d::from(input.translation)),
      position_(-1.0 * (rotation_.transpose() * translation_)), axes_(cast<float>(rotation_.transpose())) {
  for (int a = 0; a < 3; ++a) {
    const Vec3d& r = rotation_.row[a];
    extent_[a] = static_cast<float>(0.5 * block_ * (std::fabs(r[0]) + std::fabs(r[1]) + std::fabs(r[2])));
    spread_[a] = std::fabs(axes_(a, 0)) / in_.fx + std::fabs(axes_(a, 1)) / in_.fy;
  }
  Vec3d low, high;
  const Mat3d axes = cast<double>(axes_);
  const double far = std::min(images.farthest, settings.max_depth) + map.truncation;
  const double right[2] = {(-0.5 - in_.cx) / in_.fx, (in_.width - 0.5 - in_.cx) / in_.fx};
  const double down[2] = {(-0.5 - in_.cy) / in_.fy, (in_.height - 0.5 - in_.cy) / in_.fy};
  for (int corner = -1; corner < 4; ++corner) {
    const double z = corner < 0 ? 0 : far;
    const Vec3d x = position_ + z * right[corner & 1] * axes.column(0) + z * down[(corner >> 1) & 1] * axes.column(1) +
                    z * axes.column(2);
    low = corner < 0 ? x : min(low, x);
    high = corner < 0 ? x : max(high, x);
  }
  check_extent(low, high, block_);
  do {
    cell_ *= 2;
    first_ = floor(low / (cell_ * block_));
    count_ = floor(high / (cell_ * block_)) - first_ + Vec3i::all(1);
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
  const Cube cube = this->cube(at, side);
  Footprint area;
  if (!footprint(cube, side, area)) return;
  const int top = static_cast<int>(images_.pyramid.levels.size()) - 1;
  // The coarsest tiles of which the footprint meets few.
  int level = 0;
  while (level < top && std::max(area.u1 - area.u0, area.v1 - area.v0) >> level > 2) ++level;
  unsigned seen = 0;
  for (int v = area.v0 >> level; v <= area.v1 >> level && !(seen & kAt); ++v)
    for (int u = area.u0 >> level; u <= area.u1 >> level && !(seen & kAt); ++u)
      seen |= look(level, u, v, area, cube);
  if ((seen & (kAt | kBehind | kPassed)) == 0) return;  // no depth, or hidden
  const bool beyond = (seen & kPassed) != 0 || cube.far > settings_.max_depth;
  const bool is_free = seen == kBehind && area.whole && !beyond;
  if (side == 1) {
    const bool enough = is_free && valid_share(area) >= settings_.free_share;
    const Sight sight = seen & kAt ? Sight::surface
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

// A cube of side^3 blocks.
CandidateSearch::Cube CandidateSearch::cube(BlockCoordinates at, int side) const {
  const Vec3d p = block_ * (cast<double>(vector_of(at)) + Vec3d::all(0.5 * side));
  Cube out;
  out.half = static_cast<float>(0.5 * side * block_);
  out.centre = cast<float>(rotation_ * p + translation_);
  out.offset = cast<float>(p - position_);
  out.near = out.centre[2] - side * extent_[2], out.far = out.centre[2] + side * extent_[2];
  return out;
}

// The tiles on which a cube falls; false if there are none.
bool CandidateSearch::footprint(const Cube& cube, int side, Footprint& out) const {
  const float far = cube.far, start = std::max(cube.near, kNear);
  if (far <= kNear) return false;
  const float sizes[2] = {static_cast<float>(in_.width), static_cast<float>(in_.height)};
  const float focal[2] = {in_.fx, in_.fy}, middle[2] = {in_.cx, in_.cy};
  int low[2], high[2];
  out.whole = cube.near >= kNear;
  for (int a = 0; a < 2; ++a) {
    const float left = cube.centre[a] - side * extent_[a], right = cube.centre[a] + side * extent_[a];
    const float p0 = focal[a] * left / (left < 0 ? start : far) + middle[a] + 0.5f;
    const float p1 = focal[a] * right / (right > 0 ? start : far) + middle[a] + 0.5f;
    if (p1 < 0 || p0 >= sizes[a]) return false;
    out.whole = out.whole && p0 >= 0 && p1 < sizes[a];
    low[a] = static_cast<int>(std::max(p0, 0.0f)) / kTile;
    high[a] = static_cast<int>(std::min(p1, sizes[a] - 1)) / kTile;
  }
  out.u0 = low[0], out.v0 = low[1], out.u1 = high[0], out.v1 = high[1];
  return true;
}

// The stretch of depth in which rays through tile (u, v) of a level meet a cube; false if none does. Along each axis of
// the map, the rays at depth z spread over z (direction +- spread).
bool CandidateSearch::meets(int level, int u, int v, const Cube& cube, float& z0, float& z1) const {
  const float half = 0.5f * static_cast<float>(kTile << level);
  const float x = ((2 * u + 1) * half - 0.5f - in_.cx) / in_.fx, y = ((2 * v + 1) * half - 0.5f - in_.cy) / in_.fy;
  z0 = std::max(cube.near, kNear), z1 = cube.far;
  for (int a = 0; a < 3; ++a) {
    const float direction = axes_(a, 0) * x + axes_(a, 1) * y + axes_(a, 2);
    const float spread = half * spread_[a];
    const float low = cube.offset[a] - cube.half, high = cube.offset[a] + cube.half;
    // z (direction + spread) >= low and z (direction - spread) <= high
    const float most = direction + spread, least = direction - spread;
    if (most > 0) z0 = std::max(z0, low / most);
    else if (most < 0) z1 = std::min(z1, low / most);
    else if (low > 0) return false;
    if (least > 0) z1 = std::min(z1, high / least);
    else if (least < 0) z0 = std::max(z0, high / least);
    else if (high < 0) return false;
  }
  return z0 <= z1;
}

// What tile (u, v) of a level shows, as far as it belongs to the footprint.
unsigned CandidateSearch::look(int level, int u, int v, const Footprint& area, const Cube& cube) const {
  const DepthPyramid::Level& l = images_.pyramid.levels[level];
  const DepthTile tile = l.tiles[static_cast<std::size_t>(v) * l.width + u];
  if (tile.high <= 0) return 0;
  if (tile.low > cube.far + map_.truncation) return kBehind;
  if (tile.high < cube.near - map_.truncation) return kInFront;
  float low, high;
  if (!meets(level, u, v, cube, low, high)) return 0;
  low -= map_.truncation, high += map_.truncation;
  if (tile.low > high) return kBehind;
  if (tile.high < low) return kInFront;
  if (level == 0) {
    if (tile.high > settings_.max_depth) return look_beyond(u, v, low, high);
    if (tile.low >= low || tile.high <= high) return kAt;
    return look_at_pixels(u, v, low, high);
  }
  const int u0 = std::max(2 * u, area.u0 >> (level - 1)), u1 = std::min(2 * u + 1, area.u1 >> (level - 1));
  const int v0 = std::max(2 * v, area.v0 >> (level - 1)), v1 = std::min(2 * v + 1, area.v1 >> (level - 1));
  unsigned seen = 0;
  for (int y = v0; y <= v1 && !(seen & kAt); ++y)
    for (int x = u0; x <= u1 && !(seen & kAt); ++x) seen |= look(level - 1, x, y, area, cube);
  return seen;
}

// The same for a tile that has depth in front and behind: a silhouette has nothing between.
unsigned CandidateSearch::look_at_pixels(int u, int v, float low, float high) const {
  const int u1 = std::min((u + 1) * kTile, in_.width), v1 = std::min((v + 1) * kTile, in_.height);
  for (int y = v * kTile; y < v1; ++y)
    for (int x = u * kTile; x < u1; ++x) {
      const float z = images_.depth[static_cast<std::size_t>(y) * in_.width + x];
      if (z >= low && z <= high) return kAt;
    }
  return kBehind | kInFront;
}

// The same for a tile with depth beyond the range.
unsigned CandidateSearch::look_beyond(int u, int v, float low, float high) const {
  const int u1 = std::min((u + 1) * kTile, in_.width), v1 = std::min((v + 1) * kTile, in_.height);
  unsigned seen = 0;
  for (int y = v * kTile; y < v1; ++y)
    for (int x = u * kTile; x < u1; ++x) {
      const float z = images_.depth[static_cast<std::size_t>(y) * in_.width + x];
      if (z <= 0) continue;
      seen |= z > high ? kBehind : z < low ? kInFront : z > settings_.max_depth ? kPassed : kAt;
    }
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
