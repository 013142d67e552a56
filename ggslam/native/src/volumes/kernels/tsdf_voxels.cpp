// SPDX-License-Identifier: Apache-2.0
// Fuses a view into the voxels of a block, kLanes voxels at a time.
#include <algorithm>
#include <cstring>

#include "volumes/kernels/voxel_vectors.hpp"
#include "native/formulas/tsdf_voxel.hpp"
#include "volumes/tsdf_scratch.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

using volumes::kFreeValue;
using volumes::kFullWeight;
using volumes::kSide;
using volumes::kVoxels;
using volumes::VoxelBlock;
using volumes::VoxelUpdate;

constexpr int kGroups = kVoxels / kLanes;

struct List {
  std::uint8_t group[kGroups];
  int count = 0;
  void add(int g, bool wanted) {
    group[count] = static_cast<std::uint8_t>(g);
    count += wanted;
  }
};

struct Work {
  Sighted groups[kGroups];
  List near, seen, band;
};

// Projects the voxels and compares them with the nearest pixel.
void project(const VoxelUpdate& t, Work& w) {
  Float offset[3];
  for (int a = 0; a < 3; ++a)
    for (int lane = 0; lane < kLanes; ++lane)
      offset[a][lane] = (lane & 7) * t.step[0][a] + (lane >> 3) * t.step[1][a];
  for (int n = 0; n < kGroups; ++n) {
    const int first = n * kLanes;
    const float i = first & 7, j = first >> 3 & 7, k = first >> 6;
    Float p[3];
    for (int a = 0; a < 3; ++a)
      p[a] = offset[a] + (t.origin[a] + i * t.step[0][a] + j * t.step[1][a] + k * t.step[2][a]);
    Mask seen, near;
    w.groups[n] = compared(t, p, seen, near);
    w.near.add(n, any(near));
    w.seen.add(n, any(seen));
  }
}

// Takes the mean of what rays told the voxels, which is then forgotten. Where the nearest pixel looks past a voxel, or
// ends before it, it is left to that: rays of a thin thing's pixels would widen it by half a voxel.
void gather_rays(const VoxelUpdate& t, Work& w) {
  const float unit = t.truncation / volumes::RaySum::kUnits;
  for (int n = 0; n < kGroups; ++n) {
    Sighted& g = w.groups[n];
    volumes::RaySum* const sums = t.rays + n * kLanes;
    for (int lane = 0; lane < kLanes; ++lane) {
      const volumes::RaySum sum = sums[lane];
      const float distance = g.distance[lane];
      if (!(distance < t.truncation && distance >= -t.truncation)) continue;
      if (sum.count >= (t.rays_alone ? 1 : t.least_rays))
        g.distance[lane] = unit * static_cast<float>(sum.distance) / static_cast<float>(sum.count);
      else if (t.rays_alone)
        g.distance[lane] = kNothing;
    }
    std::fill(sums, sums + kLanes, volumes::RaySum{});
  }
}

typedef std::uint8_t Bytes __attribute__((vector_size(4 * kLanes), aligned(1), may_alias));
constexpr int kBytes = 4 * kLanes;

static inline Bytes every(std::uint8_t byte) { return byte - Bytes{}; }
static inline Bytes& bytes_at(std::uint8_t* p) { return *reinterpret_cast<Bytes*>(p); }
static inline Bytes choose(Bytes mask, Bytes a, Bytes b) { return (a & mask) | (b & ~mask); }
static inline bool any_byte(const Bytes& v) {
  std::uint64_t words[kBytes / 8], all = 0;
  std::memcpy(words, &v, kBytes);
  for (std::uint64_t word : words) all |= word;
  return all != 0;
}

// Counts hits and misses of the voxels. Returns whether what is occupied changed.
bool count_points(const VoxelUpdate& t, const Work& w) {
  volumes::PointBlock& block = *t.points;
  const Bytes least = every(volumes::kLeastHits), most = every(volumes::kMostHits), occupied = every(volumes::kOccupied);
  if (t.octants == nullptr) {
    Bytes other{};
    for (int k = 0; k < kVoxels; k += kBytes) other |= bytes_at(block.hits + k) ^ least;
    if (!any_byte(other)) return false;  // misses have nothing to take away
  }
  alignas(64) std::uint8_t missed[kVoxels];
  const Float far = broadcast(t.voxel), one = broadcast(1.0f);
  for (int n = 0; n < kGroups; ++n)
    store_narrowed(missed + n * kLanes, truncate(zero_unless(greater_equal(w.groups[n].distance, far), one)));
  Bytes changed{};
  for (int k = 0; k < kVoxels; k += kBytes) {
    const Bytes before = bytes_at(block.hits + k), octants = bytes_at(block.octants + k);
    const Bytes now = t.octants == nullptr ? Bytes{} : bytes_at(t.octants + k);
    const Bytes hit = (Bytes)(now != 0), miss = (Bytes)(bytes_at(missed + k) != 0);
    const Bytes start = choose((Bytes)(before == volumes::kNeverSeen), occupied, before);
    const Bytes up = start + std::uint8_t{volumes::kHit}, down = start - std::uint8_t{volumes::kMiss};
    const Bytes after = choose(hit, choose((Bytes)(up < most), up, most),
                               choose(miss, choose((Bytes)(down > least), down, least), before));
    const Bytes is = (Bytes)(after >= occupied), was = (Bytes)(before >= occupied);
    const Bytes kept = (now | octants) & (hit | is);
    changed |= (is ^ was) | (is & kept & ~octants);
    bytes_at(block.hits + k) = after, bytes_at(block.octants + k) = kept;
  }
  if (t.octants != nullptr) std::memset(t.octants, 0, kVoxels);
  return any_byte(changed);
}

// Averages values and weights.
void average(const VoxelUpdate& t, Work& w, int n, VoxelBlock& block, Mask& changed) {
  const int first = n * kLanes;
  Sighted& g = w.groups[n];
  const Averaged now = averaged(t, g, load_widened(block.value + first), load_widened(block.weight + first));
  store_narrowed(block.value + first, now.value);
  store_narrowed(block.weight + first, now.weight);
  changed = either(changed, now.changed);
  w.band.add(n, any(now.band));
}

// Colours of voxels within the truncation.
void paint(const VoxelUpdate& t, const Sighted& g, int first, VoxelBlock& block) {
  const Int color = gather_int(t.color, g.pixel);
  const Int red = load_widened(block.red + first), green = load_widened(block.green + first),
            blue = load_widened(block.blue + first);
  const Float share = color_share(greater_equal_int(Int{}, red | green | blue), g.share);
  store_narrowed(block.red + first, blended(red, color & 255, share));
  store_narrowed(block.green + first, blended(green, color >> 8 & 255, share));
  store_narrowed(block.blue + first, blended(blue, color >> 16 & 255, share));
}

// Votes of voxels at the surface for a label; whether one changed its label.
bool vote(const VoxelUpdate& t, const Sighted& g, int first, VoxelBlock& block) {
  bool changed = false;
  const Float most = broadcast(volumes::kLabelVoxels * t.voxel);
  const Mask near = both(greater(g.share, Float{}), greater_equal(most, absolute(g.distance)));
  for (std::uint32_t lanes = bits(near); lanes; lanes &= lanes - 1) {
    const int lane = __builtin_ctz(lanes), k = first + lane;
    const std::uint16_t label = t.labels[g.pixel[lane]];
    if (label == 0) continue;
    changed |= vote_for(label, block.label[k], block.votes[k]);
  }
  return changed;
}

unsigned summary(const VoxelBlock& block, const volumes::PointBlock* points) {
  int weights = 0, unseen = 0, occupied = 0;
  for (int k = 0; k < kVoxels; ++k) {
    weights |= block.weight[k];
    unseen |= block.weight[k] == 0;
    occupied |= block.value[k] != kFreeValue;
  }
  std::uint8_t hits = 0;
  for (int k = 0; points != nullptr && k < kVoxels; ++k) hits |= points->hits[k];
  static_assert(volumes::kOccupied == 128 && volumes::kMostHits < 256);  // the highest bit
  if (hits & volumes::kOccupied) return 0;
  return (weights == 0 ? volumes::kNoneSeen : 0u) | (unseen == 0 && occupied == 0 ? volumes::kAllFree : 0u);
}

}  // namespace

// Returns what happened, in bits.
unsigned tsdf_fuse_block(const VoxelUpdate& t, VoxelBlock& block) {
  if (t.points != nullptr)  // lie elsewhere, and are needed last
    for (std::size_t at = 0; at < sizeof *t.points; at += 64) __builtin_prefetch(reinterpret_cast<const char*>(t.points) + at, 1);
  Work w;
  project(t, w);
  for (int n = 0; n < w.near.count; ++n) interpolate(t, w.groups[w.near.group[n]]);
  if (t.rays != nullptr) gather_rays(t, w);
  Mask changed{};
  for (int n = 0; n < w.seen.count; ++n) average(t, w, w.seen.group[n], block, changed);
  const bool points = t.octants != nullptr;
  bool relabelled = t.points != nullptr && count_points(t, w);
  for (int n = 0; n < w.band.count; ++n) {
    const int first = w.band.group[n] * kLanes;
    if (t.color != nullptr) paint(t, w.groups[w.band.group[n]], first, block);
    if (t.labels != nullptr) relabelled |= vote(t, w.groups[w.band.group[n]], first, block);
  }
  return (relabelled || any(changed) ? volumes::kChanged : 0u) | (w.band.count > 0 || points ? volumes::kInBand : 0u) |
         summary(block, t.points);
}

// Multiplies the weights; voxels whose weight falls below `least` are forgotten. Returns what happened, in bits.
unsigned tsdf_decay_block(VoxelBlock& block, volumes::PointBlock* points, float factor, int least) {
  unsigned flags = 0;
  for (int k = 0; k < kVoxels; ++k) {
    const int weight = static_cast<int>(block.weight[k] * factor + 0.5f);
    const bool forgotten = weight < least && block.weight[k] > 0;
    block.weight[k] = weight < least ? 0 : static_cast<std::uint16_t>(weight);
    if (block.weight[k] == 0 && points != nullptr) {
      flags |= points->hits[k] >= volumes::kOccupied ? volumes::kChanged : 0u;
      points->hits[k] = points->octants[k] = 0;
    }
    if (!forgotten) continue;
    block.value[k] = kFreeValue, block.label[k] = 0, block.votes[k] = 0;
    block.red[k] = block.green[k] = block.blue[k] = 0;
    flags |= volumes::kChanged;
  }
  return flags | summary(block, points);
}

}  // namespace ggslam::GGSLAM_ISA
