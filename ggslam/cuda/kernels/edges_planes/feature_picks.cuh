// SPDX-License-Identifier: Apache-2.0
// Picks edges and planes by their scores and writes them one behind the other: first the planes of all segments of all
// rows, then the edges of all segments of all lines. One warp picks on one segment.
#pragma once
#include "common/carver.cuh"
#include "edges_planes/plane_patches.cuh"
#include "common/block_median.cuh"

namespace ggslam::cuda {

constexpr int kPickThreads = 128;

struct ScanWorkspace {
  float *edge_scores, *plane_scores;  // [lines or rows, inner places]
  std::int32_t* survivors;            // [groups, segment] places that beat their neighbours
  std::int32_t* kept;                 // [groups, segment] places that are features
  std::int32_t* counts;               // [groups] of `kept`
  std::size_t bytes;
};

__host__ __device__ inline int plane_groups(const FeatureSettings& s) { return s.rows * s.segments; }
__host__ __device__ inline int all_groups(const FeatureSettings& s) { return (s.rows + s.lines) * s.segments; }

inline ScanWorkspace scan_workspace(void* block, const FeatureSettings& s) {
  Carver carver(block);
  const std::int64_t inner = inner_places(s), places = static_cast<std::int64_t>(all_groups(s)) * s.segment;
  ScanWorkspace w;
  w.edge_scores = carver.take<float>(s.lines * inner);
  w.plane_scores = carver.take<float>(s.rows * inner);
  w.survivors = carver.take<std::int32_t>(places);
  w.kept = carver.take<std::int32_t>(places);
  w.counts = carver.take<std::int32_t>(all_groups(s));
  w.bytes = carver.used();
  return w;
}

// A segment of a line, on which planes or edges are picked.
struct PickGroup {
  bool planes;
  int line, begin, end, most;
};

__host__ __device__ inline PickGroup group_of(const FeatureSettings& s, int number) {
  PickGroup group;
  group.planes = number < plane_groups(s);
  const int own = group.planes ? number : number - plane_groups(s);
  group.line = own / s.segments;
  group.begin = own % s.segments * s.segment;
  group.end = min(group.begin + s.segment, inner_places(s));
  group.most = group.planes ? s.planes_per_segment : s.edges_per_segment;
  return group;
}

// Whether all that beat their neighbours are picked: there are hardly more of them.
__host__ __device__ inline bool picks_all(const FeatureSettings& s, int most) { return most * (kHalf + 1) >= s.segment; }

// Whether no neighbour has a higher score; one that is not a number beats all.
__device__ inline bool beats_neighbours(const float* scores, int inner, int place) {
  const float own = scores[place];
  bool beats = own > 0;
  for (int k = max(place - kHalf, 0); k <= min(place + kHalf, inner - 1); ++k) beats = beats && scores[k] <= own;
  return beats;
}

__device__ inline unsigned lanes_below(int lane) { return (1u << lane) - 1; }

// Writes the places of a group that beat their neighbours, in order; how many there are, and how many scores are no
// numbers.
__device__ inline int find_survivors(const float* scores, int inner, const PickGroup& group, int lane, int* out,
                                     int* unknown) {
  int found = 0;
  *unknown = 0;
  for (int first = group.begin; first < group.end; first += kWarp) {
    const int place = first + lane;
    const bool inside = place < group.end;
    const bool survives = inside && beats_neighbours(scores, inner, place);
    const unsigned bits = __ballot_sync(kAllLanes, survives);
    *unknown += __popc(__ballot_sync(kAllLanes, inside && scores[place] != scores[place]));
    if (survives) out[found + __popc(bits & lanes_below(lane))] = place;
    found += __popc(bits);
  }
  __syncwarp();
  return found;
}

// Writes the best of them, the best first, of equal ones the first; how many these are. Scores that are no numbers rank
// before all others, and are left out.
__device__ inline int choose_best(const float* scores, const int* survivors, int found, int most, int lane, int* out) {
  for (int i = lane; i < found; i += kWarp) {
    const float own = scores[survivors[i]];
    int rank = 0;
    for (int k = 0; k < found; ++k) {
      const float other = scores[survivors[k]];
      rank += other > own || (other == own && k < i);
    }
    if (rank < most) out[rank] = survivors[i];
  }
  __syncwarp();
  return min(found, most);
}

__global__ void __launch_bounds__(kPickThreads) pick_kernel(FeatureScanJob job, ScanWorkspace work) {
  const FeatureSettings& s = job.settings;
  const int number = static_cast<int>(blockIdx.x * kPickThreads + threadIdx.x) / kWarp;
  const int lane = static_cast<int>(threadIdx.x % kWarp), inner = inner_places(s);
  if (number >= all_groups(s)) return;
  const PickGroup group = group_of(s, number);
  const float* all_scores = group.planes ? work.plane_scores : work.edge_scores;
  const float* scores = all_scores + static_cast<std::int64_t>(group.line) * inner;
  std::int32_t* survivors = work.survivors + static_cast<std::int64_t>(number) * s.segment;
  std::int32_t* kept = work.kept + static_cast<std::int64_t>(number) * s.segment;
  int unknown, chosen = 0;
  if (group.most > 0) chosen = find_survivors(scores, inner, group, lane, survivors, &unknown);
  const std::int32_t* order = survivors;
  if (group.most > 0 && !picks_all(s, group.most)) {
    chosen = choose_best(scores, survivors, chosen, max(group.most - unknown, 0), lane, kept);
    order = kept;
  }
  int good = 0;
  for (int first = 0; first < chosen; first += kWarp) {
    const int place = first + lane < chosen ? order[first + lane] : -1;
    PlanePatch patch;
    const PixelPlace at = pixel_on_line(s, group.line, place + kHalf);
    const bool passes = place >= 0 && (group.planes ? fit_patch(job, at, patch) : turns_at(job, group.line, place));
    const unsigned bits = __ballot_sync(kAllLanes, passes);  // all have read their places before one is overwritten
    if (passes) kept[good + __popc(bits & lanes_below(lane))] = place;
    good += __popc(bits);
  }
  if (lane == 0) work.counts[number] = good;
}

__device__ inline void write_feature(const FeatureScanJob& job, const PickGroup& group, int place, int n) {
  const FeatureSettings& s = job.settings;
  const FeatureArrays& out = job.out;
  const PixelPlace at = pixel_on_line(s, group.line, place + kHalf);
  if (group.planes) {
    PlanePatch patch;
    fit_patch(job, at, patch);
#pragma unroll
    for (int a = 0; a < 3; ++a) out.planes[3 * n + a] = patch.point[a], out.normals[3 * n + a] = patch.normal[a];
    out.discs[n] = patch.z * s.disc_per_depth;
    out.plane_sigmas[n] = feature_sigma(s, patch.z);
    return;
  }
  const float z = depth_of(job)[static_cast<std::int64_t>(at.v) * s.width + at.u];
  out.edges[3 * n] = ray_x(s, at.u) * z, out.edges[3 * n + 1] = ray_y(s, at.v) * z, out.edges[3 * n + 2] = z;
  out.edge_sigmas[n] = feature_sigma(s, z);
}

// Writes the features of each segment behind those of the segments before it.
__global__ void __launch_bounds__(kPickThreads) write_features_kernel(FeatureScanJob job, ScanWorkspace work) {
  const FeatureSettings& s = job.settings;
  const int number = static_cast<int>(blockIdx.x * kPickThreads + threadIdx.x) / kWarp;
  const int lane = static_cast<int>(threadIdx.x % kWarp), planes = plane_groups(s), all = all_groups(s);
  if (number == 0 && lane == 0 && planes == 0) job.out.header->planes = 0;
  if (number == 0 && lane == 0 && all == planes) job.out.header->edges = 0;
  if (number >= all) return;
  const PickGroup group = group_of(s, number);
  unsigned before = 0;
  for (int g = (group.planes ? 0 : planes) + lane; g < number; g += kWarp)
    before += static_cast<unsigned>(work.counts[g]);
  const auto first = static_cast<int>(__reduce_add_sync(kAllLanes, before));
  const std::int32_t* kept = work.kept + static_cast<std::int64_t>(number) * s.segment;
  const int count = work.counts[number];
  if (lane == 0 && number == planes - 1) job.out.header->planes = first + count;
  if (lane == 0 && number == all - 1) job.out.header->edges = first + count;
  for (int k = lane; k < count; k += kWarp) write_feature(job, group, kept[k], first + k);
}

// Number `i` of `used` ones that are evenly taken from `count`.
__device__ inline std::int64_t thinned(int i, int used, int count) {
  return static_cast<std::int64_t>(i) * count / max(used, 1);
}

// Medians of planes, the lower of the two middle ones: one block for the depth, one for the distance of all, one for that
// of those that are aligned.
__global__ void __launch_bounds__(kMedianThreads) feature_medians_kernel(FeatureScanJob job) {
  GGSLAM_SHARED unsigned room[kMedianThreads / kWarp];
  FeatureHeader& header = *job.out.header;
  const int which = static_cast<int>(blockIdx.x), count = header.planes;
  const int used = which == 2 ? min(count, job.most_planes) : count;
  const auto bits_of = [&](int i) {
    const float* p = job.out.planes + 3 * (which == 2 ? thinned(i, used, count) : i);
    return __float_as_uint(which == 0 ? p[2] : p[0] * p[0] + p[1] * p[1] + p[2] * p[2]);
  };
  const float median = used > 0 ? __uint_as_float(block_lower_median(used, used, bits_of, room)) : 0.0f;
  if (threadIdx.x != 0) return;
  (which == 0 ? header.median_depth : which == 1 ? header.median_distance : header.thin_median_distance) =
      which == 0 ? median : sqrtf(median);
}

}  // namespace ggslam::cuda
