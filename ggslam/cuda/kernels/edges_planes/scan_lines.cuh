// SPDX-License-Identifier: Apache-2.0
// Scan lines of a depth image, and for each place on them with ten neighbours how well it would do as an edge and as a
// plane: the rules of LineScanner in ggslam/tracking/edges_planes/extraction.py, where they are explained. What decides is
// rounded step by step as there, however a compiler would join products and sums.
#pragma once
#include "abi/cuda/tracked_features.hpp"
#include "common/host.cuh"

namespace ggslam::cuda {

constexpr int kHalf = 5;  // neighbours on either side
constexpr int kWindow = 2 * kHalf + 1;
constexpr float kNoiseGain = 2 * kHalf + 4 * kHalf * kHalf;  // variance of 10 neighbours minus 10 times the place
constexpr int kScoreThreads = 128;

// Places of a line that have ten neighbours.
__host__ __device__ inline int inner_places(const FeatureSettings& s) { return s.length - 2 * kHalf; }

struct PixelPlace {
  int u, v;
};

__device__ inline PixelPlace pixel_on_line(const FeatureSettings& s, int line, int place) {
  if (line < s.rows) return {place * s.pitch, s.first_row + line * s.row_step};
  return {s.first_column + (line - s.rows) * s.column_step, place * s.pitch};
}

// The image that features are looked for in.
__device__ inline const float* depth_of(const FeatureScanJob& job) {
  return job.small.filtered != nullptr ? job.small.filtered : job.depth;
}

// Viewing ray of a pixel; its z is 1.
__device__ inline float ray_x(const FeatureSettings& s, int u) { return (static_cast<float>(u) - s.cx) / s.fx; }
__device__ inline float ray_y(const FeatureSettings& s, int v) { return (static_cast<float>(v) - s.cy) / s.fy; }

// Standard deviation of a depth on a line, and the same of a feature's: the order of products differs as on the CPU.
__device__ inline float depth_sigma(const FeatureSettings& s, float z) {
  return __fadd_rn(__fmul_rn(__fmul_rn(z, z), s.noise_square), s.noise_constant);
}
__device__ inline float feature_sigma(const FeatureSettings& s, float z) {
  return __fadd_rn(__fmul_rn(__fmul_rn(s.noise_square, z), z), s.noise_constant);
}

// A place and its neighbours: depths, 0 where there is none, and viewing rays, of which one coordinate is the same for
// all.
struct LineWindow {
  float z[kWindow], along[kWindow], across;
};

__device__ inline void read_window(const FeatureScanJob& job, int line, int first, LineWindow& window) {
  const FeatureSettings& s = job.settings;
  const float* depth = depth_of(job);
  const bool is_row = line < s.rows;
#pragma unroll
  for (int k = 0; k < kWindow; ++k) {
    const PixelPlace at = pixel_on_line(s, line, first + k);
    const bool inside = at.u < s.width && at.v < s.height;
    const float z = inside ? depth[static_cast<std::int64_t>(at.v) * s.width + at.u] : 0.0f;
    window.z[k] = z >= s.min_depth && z <= s.max_depth ? z : z * 0.0f;  // what is not a number stays that
    window.along[k] = is_row ? ray_x(s, at.u) : ray_y(s, at.v);
    if (k == kHalf) window.across = is_row ? ray_y(s, at.v) : ray_x(s, at.u);
  }
}

// Coordinate of point k of a window: along the line, across it, and depth.
__device__ inline float coordinate(const LineWindow& window, int axis, int k) {
  if (axis == 2) return window.z[k];
  return __fmul_rn(axis == 0 ? window.along[k] : window.across, window.z[k]);
}

// The neighbours before and after the place, each minus the place, added up.
struct NeighbourSums {
  float before[3], after[3];
};

__device__ inline NeighbourSums sum_neighbours(const LineWindow& window) {
  NeighbourSums sums;
#pragma unroll
  for (int a = 0; a < 3; ++a) {
    float before = __fadd_rn(coordinate(window, a, 0), coordinate(window, a, 1));
    float after = __fadd_rn(coordinate(window, a, kHalf + 1), coordinate(window, a, kHalf + 2));
#pragma unroll
    for (int k = 2; k < kHalf; ++k) {
      before = __fadd_rn(before, coordinate(window, a, k));
      after = __fadd_rn(after, coordinate(window, a, kHalf + 1 + k));
    }
    const float middle = coordinate(window, a, kHalf);
    sums.before[a] = __fmaf_rn(middle, -static_cast<float>(kHalf), before);
    sums.after[a] = __fmaf_rn(middle, -static_cast<float>(kHalf), after);
  }
  return sums;
}

// Sum of squares of three coordinates, along and across a line being x and y in its order or not.
__device__ inline float sum_of_squares(const float (&v)[3], bool is_row) {
  const float along = __fmul_rn(v[0], v[0]), across = __fmul_rn(v[1], v[1]);
  return __fadd_rn(is_row ? __fadd_rn(along, across) : __fadd_rn(across, along), __fmul_rn(v[2], v[2]));
}

// Equation 1 over what noise makes of it on a straight line.
__device__ inline float curvature_of(const FeatureSettings& s, const LineWindow& window, bool is_row) {
  const NeighbourSums sums = sum_neighbours(window);
  float difference[3];
#pragma unroll
  for (int a = 0; a < 3; ++a) difference[a] = __fadd_rn(sums.before[a], sums.after[a]);
  const float z = window.z[kHalf], sigma = depth_sigma(s, z);
  const float rough = __fmul_rn(__fmul_rn(s.squared_roughness, z), z);
  const float variance = __fmul_rn(__fadd_rn(__fmul_rn(sigma, sigma), rough), kNoiseGain);
  return sum_of_squares(difference, is_row) / (variance < 1e-12f ? 1e-12f : variance);
}

// Whether the place and its neighbours are one surface; whether it is the last of a surface on one side and the next one
// belongs to a farther one.
struct PlaceBorders {
  bool continuous, near;
};

__device__ inline PlaceBorders borders_of(const FeatureSettings& s, const LineWindow& window) {
  bool gap_before = false, gap_after = false, rises = false, falls = false;
#pragma unroll
  for (int k = 0; k + 1 < kWindow; ++k) {
    const float one = window.z[k], next = window.z[k + 1], step = next - one;
    const float least = next < one ? next : one;
    const float limit = __fadd_rn(__fmul_rn(least, s.gap), __fmul_rn(4.0f, depth_sigma(s, next)));
    const bool is_gap = step > limit || step < -limit;
    if (k < kHalf) gap_before = gap_before || is_gap;
    if (k >= kHalf) gap_after = gap_after || is_gap;
    if (k == kHalf - 1) falls = step < -limit;
    if (k == kHalf) rises = step > limit;
  }
  const bool measured = window.z[kHalf] > 0;
  return {measured && !(gap_before || gap_after), measured && ((rises && !gap_before) || (falls && !gap_after))};
}

// Scores of all places: curvature of what may be an edge, flatness of what may be a plane, 0 for all else, and not a
// number where depth is not.
__global__ void __launch_bounds__(kScoreThreads) score_kernel(FeatureScanJob job, float* edge_scores, float* plane_scores) {
  const FeatureSettings& s = job.settings;
  const int inner = inner_places(s), number = static_cast<int>(blockIdx.x * kScoreThreads + threadIdx.x);
  if (number >= s.lines * inner) return;
  const int line = number / inner;
  LineWindow window;
  read_window(job, line, number - line * inner, window);
  const PlaceBorders borders = borders_of(s, window);
  const float curvature = curvature_of(s, window, line < s.rows);
  const bool may_be_edge = borders.continuous || (s.occluding_edges && borders.near);
  edge_scores[number] = may_be_edge && curvature > s.edge_curvature ? curvature : curvature * 0.0f;
  if (line >= s.rows) return;
  // Among places that are flat as far as noise lets one see, chance decides: the least would line up in columns.
  const float flatness = job.dither[number] / (curvature < 1.0f ? 1.0f : curvature);
  plane_scores[number] = borders.continuous && curvature < s.plane_curvature ? flatness : flatness * 0.0f;
}

// Whether the line turns enough at a place (equation 2).
__device__ inline bool turns_at(const FeatureScanJob& job, int line, int first) {
  LineWindow window;
  read_window(job, line, first, window);
  const NeighbourSums sums = sum_neighbours(window);
  const bool is_row = line < job.settings.rows;
  const int x = is_row ? 0 : 1, y = 1 - x;
  const float product = -(sums.before[x] * sums.after[x] + sums.before[y] * sums.after[y] + sums.before[2] * sums.after[2]);
  const float lengths = sqrtf(sum_of_squares(sums.before, is_row) * sum_of_squares(sums.after, is_row));
  return product < job.settings.turn_cosine * lengths;
}

}  // namespace ggslam::cuda
