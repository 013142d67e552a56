// SPDX-License-Identifier: Apache-2.0
// Fuses a view into the voxels of a block, kLanes voxels at a time.
#include <algorithm>
#include <cstring>

#include "volumes/kernels/voxel_vectors.hpp"
#include "volumes/tsdf_scratch.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

using volumes::kFreeValue;
using volumes::kFullWeight;
using volumes::kSide;
using volumes::kVoxels;
using volumes::VoxelBlock;
using volumes::VoxelUpdate;

constexpr float kSurprise = 0.5f;           // of the truncation: how far depth must contradict a voxel to clear it
constexpr float kDoubt = 0.03f;             // of a voxel's depth: passing it by so little more proves nothing
constexpr float kDoubtfulShare = 0.03f;     // of the voxel's weight that what proves nothing counts at most
constexpr float kFreeFrom = 0.98f * kFreeValue;  // a voxel seen as free counts as free from this value on
constexpr float kRangeSlack = 1.00001f;     // of the range: rounding when depth is added up again
constexpr float kLabelVoxels = 2.0f;        // labels are told to voxels this near to the surface
constexpr float kColorShare = 0.125f;       // of a new colour at least: less would be rounded away

static inline Float rounded(Float v) { return to_float(truncate(v + 0.5f)); }

// What is known of a block's voxels, step by step. Groups of kLanes voxels that need a step are listed without a
// branch: whether they do is anyone's guess, and the next groups need not wait for it.
struct Group {
  Float z, inverse, u, v;
  Float distance;  // to the surface along the optical axis, positive in front; kNothing: unknown
  Float share;     // of the new measurement in the voxel's mean; 0 beyond the truncation
  Int pixel;       // the nearest; 0 outside the image
};

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
  Group groups[kGroups];
  List near, seen, band;
};

constexpr float kNothing = -1e30f;

// Distance within which interpolation, which moves the depth by less than `edge` or 2 %, can matter.
static inline Float reach(const VoxelUpdate& t, Float depth) {
  return t.truncation + maximum(broadcast(t.edge), depth * 0.02f);
}

// Projects the voxels and compares them with the nearest pixel.
void project(const VoxelUpdate& t, Work& w) {
  Float offset[3];
  for (int a = 0; a < 3; ++a)
    for (int lane = 0; lane < kLanes; ++lane)
      offset[a][lane] = (lane & 7) * t.step[0][a] + (lane >> 3) * t.step[1][a];
  const Float near = broadcast(volumes::kNear), left = broadcast(-0.5f), nothing = broadcast(kNothing);
  const Float right = broadcast(t.width - 0.5f), bottom = broadcast(t.height - 0.5f);
  const Float max_depth = broadcast(t.max_depth);
  for (int n = 0; n < kGroups; ++n) {
    const int first = n * kLanes;
    const float i = first & 7, j = first >> 3 & 7, k = first >> 6;
    Float p[3];
    for (int a = 0; a < 3; ++a)
      p[a] = offset[a] + (t.origin[a] + i * t.step[0][a] + j * t.step[1][a] + k * t.step[2][a]);
    const Float inverse = 1.0f / maximum(p[2], near);
    const Float u = t.fx * (p[0] * inverse) + t.cx, v = t.fy * (p[1] * inverse) + t.cy;
    const Mask inside = both(both(greater(p[2], near), both(greater_equal(u, left), greater(right, u))),
                             both(greater_equal(v, left), greater(bottom, v)));
    const Int pixel = truncate(zero_unless(inside, v + 0.5f)) * t.width + truncate(zero_unless(inside, u + 0.5f));
    const Float depth = gather(t.depth, pixel);
    // Depth beyond the range is no surface's: it tells of what lies before it alone.
    const Float gap = depth - p[2], least = select(greater(depth, max_depth), Float{}, nothing);
    const Mask told = both(both(inside, greater(depth, Float{})), greater_equal(gap, least));
    const Float distance = select(told, gap, nothing);
    const Float band = reach(t, depth);
    const Mask seen = greater_equal(distance, -band);
    w.groups[n] = {p[2], inverse, u, v, distance, Float{}, pixel};
    w.near.add(n, any(both(seen, greater(band, distance))));
    w.seen.add(n, any(seen));
  }
}

// Takes the depth between the four pixels around a voxel, where they are all there, in range, and differ little.
void interpolate(const VoxelUpdate& t, Group& g) {
  const Float u = g.u, v = g.v;
  const Mask inside =
      both(both(greater_equal(u, Float{}), greater(broadcast(static_cast<float>(t.width - 1)), u)),
           both(greater_equal(v, Float{}), greater(broadcast(static_cast<float>(t.height - 1)), v)));
  const Mask wanted = both(inside, greater(g.distance, broadcast(kNothing)));
  const Int u0 = truncate(zero_unless(wanted, u)), v0 = truncate(zero_unless(wanted, v));
  const Int at = v0 * t.width + u0;
  Float a, b, c, d;
  gather_pairs(t.depth, at, a, b), gather_pairs(t.depth + t.width, at, c, d);
  const Float low = minimum(minimum(a, b), minimum(c, d)), high = maximum(maximum(a, b), maximum(c, d));
  const Float allowed = maximum(broadcast(t.edge), low * 0.02f);
  const Mask within = both(greater(low, Float{}), greater_equal(broadcast(t.max_depth), high));
  const Mask smooth = both(wanted, both(within, greater_equal(allowed, high - low)));
  const Float x = u - to_float(u0), y = v - to_float(v0);
  const Float top = a + x * (b - a), bottom = c + x * (d - c);
  g.distance = select(smooth, top + y * (bottom - top) - g.z, g.distance);
}

// Takes the mean of what rays told the voxels, which is then forgotten. Where the nearest pixel looks past a voxel, or
// ends before it, it is left to that: rays of a thin thing's pixels would widen it by half a voxel.
void gather_rays(const VoxelUpdate& t, Work& w) {
  const float unit = t.truncation / volumes::RaySum::kUnits;
  for (int n = 0; n < kGroups; ++n) {
    Group& g = w.groups[n];
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

// Clears voxels that the view surely looks through, with all pixels around and by more than the depth is wrong: they lose a
// share of their weight. At edges and by less, poses and depth may be at fault as well: the measurement counts little.
void clear(const VoxelUpdate& t, const Group& g, Mask through, Float& weight, Float& measured) {
  const Float needed = g.z * (1 + kDoubt) + t.truncation;
  const Mask sure = both(through, greater_equal(gather(t.eroded, g.pixel), needed));
  const Float little = minimum(measured, maximum(broadcast(1.0f), rounded(weight * kDoubtfulShare)));
  measured = select(neither_of(through, sure), little, measured);
  weight = select(sure, rounded(weight * (1 - t.clearing)), weight);
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
  Group& g = w.groups[n];
  const Float truncation = broadcast(t.truncation), one = broadcast(1.0f), full = broadcast(kFreeValue);
  const Float distance = g.distance;
  const Float drop = minimum((distance + t.truncation) * (1.0f / (t.truncation - t.voxel)), one);
  Float measured = minimum(rounded(t.weight_scale * g.inverse * g.inverse * drop), broadcast(kFullWeight));
  const Int old_value = load_widened(block.value + first), old_weight = load_widened(block.weight + first);
  const Float value = to_float(old_value);
  Float weight = to_float(old_weight);
  // Depth beyond the range makes known what is free up to the range. What a surface in range left nearer to it, or behind
  // the range, goes with that surface.
  const Mask in_range = greater_equal(broadcast(t.max_depth * kRangeSlack), distance + g.z);
  const Mask before = both(greater_equal(distance, truncation), greater_equal(broadcast(t.max_depth), g.z));
  const Mask told = either(greater(weight, Float{}), either(in_range, before));
  const Mask valid = both(told, both(greater_equal(distance, -truncation), greater_equal(measured, one)));

  const Mask behind = both(valid, greater_equal(distance, truncation));  // the surface is: the voxel is free
  const Float scaled = (kFreeValue / t.truncation) * distance;
  const Mask surface = both(greater(weight, Float{}), greater(broadcast(kFreeFrom), value));
  const Mask through = both(both(behind, surface), greater(scaled - value, full * kSurprise));
  if (t.eroded != nullptr && any(through)) clear(t, g, through, weight, measured);

  const Float total = weight + measured, share = measured / total;
  Float mean = value + share * (minimum(scaled, full) - value);
  mean = select(both(behind, greater_equal(mean, broadcast(kFreeFrom))), full, mean);
  const Float most = select(greater_equal(mean, full), broadcast(t.max_free_weight), broadcast(kFullWeight));
  // Elsewhere the mean may be anything, infinite and NaN included.
  const Int new_value = truncate(select(valid, mean, value) + 32768.5f) - 32768;
  // A weight above the limit of free space shrinks by no more than what was measured.
  const Float grown = select(valid, minimum(total, maximum(most, weight - measured)), to_float(old_weight));
  store_narrowed(block.value + first, new_value);
  store_narrowed(block.weight + first, truncate(grown));

  const Mask unseen = greater(one, to_float(old_weight));
  const Float moved = absolute(to_float(new_value - old_value));
  changed = either(changed, both(valid, either(unseen, greater(moved, Float{}))));
  const Mask band = neither_of(valid, behind);
  g.share = zero_unless(band, share);
  w.band.add(n, any(band));
}

static inline Int blended(Int old, Int now, Float share) {
  const Float from = to_float(old);
  return truncate(from + share * (to_float(now) - from) + 0.5f);
}

// Colours of voxels within the truncation.
void paint(const VoxelUpdate& t, const Group& g, int first, VoxelBlock& block) {
  const Int color = gather_int(t.color, g.pixel);
  const Int red = load_widened(block.red + first), green = load_widened(block.green + first),
            blue = load_widened(block.blue + first);
  // Black stands for a voxel that has no colour yet.
  const Mask bare = greater_equal_int(Int{}, red | green | blue);
  const Float wanted = select(bare, broadcast(1.0f), maximum(g.share, broadcast(kColorShare)));
  const Float share = zero_unless(greater(g.share, Float{}), wanted);
  store_narrowed(block.red + first, blended(red, color & 255, share));
  store_narrowed(block.green + first, blended(green, color >> 8 & 255, share));
  store_narrowed(block.blue + first, blended(blue, color >> 16 & 255, share));
}

// Votes of voxels at the surface for a label; whether one changed its label.
bool vote(const VoxelUpdate& t, const Group& g, int first, VoxelBlock& block) {
  bool changed = false;
  const Float most = broadcast(kLabelVoxels * t.voxel);
  const Mask near = both(greater(g.share, Float{}), greater_equal(most, absolute(g.distance)));
  for (std::uint32_t lanes = bits(near); lanes; lanes &= lanes - 1) {
    const int lane = __builtin_ctz(lanes), k = first + lane;
    const std::uint16_t label = t.labels[g.pixel[lane]];
    if (label == 0) continue;
    if (label == block.label[k]) {
      if (block.votes[k] < 255) ++block.votes[k];
    } else if (block.votes[k] == 0) {
      block.label[k] = label, block.votes[k] = 1, changed = true;
    } else {
      --block.votes[k];
    }
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
