// SPDX-License-Identifier: Apache-2.0
// Grey values of a frame at reduced resolution, their derivatives, and its textured points: what
// ggslam/tracking/photometric.py does with OpenCV, bit for bit. Each rounding is therefore written out: what OpenCV adds
// and multiplies apart must not be joined to one operation, and the other way round.
#pragma once
#include "common/carver.cuh"
#include "common/host.cuh"
#include "common/block_median.cuh"
#include "abi/cuda/tracking.hpp"

namespace ggslam::cuda {

constexpr int kGreyThreads = 128;

struct GreyWorkspace {
  float* grey;           // [h, w] before smoothing
  std::uint32_t* words;  // a bit for each pixel: textured
  std::size_t bytes;
};

__host__ __device__ inline int small_width(const GreyJob& job) { return job.width / job.shrink; }
__host__ __device__ inline int small_height(const GreyJob& job) { return job.height / job.shrink; }

inline GreyWorkspace grey_workspace(const GreyJob& job) {
  const std::int64_t cells = static_cast<std::int64_t>(small_width(job)) * small_height(job);
  Carver carver(job.workspace);
  GreyWorkspace w;
  w.grey = carver.take<float>(cells);
  w.words = carver.take<std::uint32_t>(blocks_for(cells + 1, kGreyThreads) * (kGreyThreads / kWarp));
  w.bytes = carver.used();
  return w;
}

// Mean of a cell's grey levels, as OpenCV rounds it.
__device__ inline int mean_level(int sum, int shrink) {
  if (shrink == 1) return sum;
  if (shrink == 2) return (sum + 2) >> 2;
  return static_cast<int>(rintf(__fmul_rn(static_cast<float>(sum), 1.0f / static_cast<float>(shrink * shrink))));
}

// One pixel per thread: mean of the cell's grey levels; its nearest depth, or 0 where one is unknown or across an edge.
__global__ void __launch_bounds__(kGreyThreads) shrink_kernel(GreyJob job, GreyWorkspace work) {
  const int i = static_cast<int>(blockIdx.x * kGreyThreads + threadIdx.x), w = small_width(job);
  if (i >= w * small_height(job)) return;
  const int u = i % w * job.shrink, v = i / w * job.shrink;
  int sum = 0;
  float nearest = __uint_as_float(0x7f800000u), furthest = 0;
  bool known = true;
  for (int y = v; y < v + job.shrink; ++y)
    for (int x = u; x < u + job.shrink; ++x) {
      const std::int64_t at = static_cast<std::int64_t>(y) * job.width + x;
      const std::uint8_t* c = job.color + 3 * at;
      sum += (c[0] * 9798 + c[1] * 19235 + c[2] * 3735 + (1 << 14)) >> 15;
      const float z = job.depth[at];
      known = known && z > 0;
      nearest = min(nearest, z), furthest = max(furthest, z);
    }
  work.grey[i] = static_cast<float>(mean_level(sum, job.shrink)) / 255.0f;
  job.pixels[4 * static_cast<std::int64_t>(i) + 3] = known && furthest < __fmul_rn(nearest, 1.03f) ? nearest : 0.0f;
}

// The pixel at (u, v), mirrored at the image's edges without repeating the edge.
__device__ inline int mirrored(int u, int size) {
  if (size == 1) return 0;
  return u < 0 ? -u : u >= size ? 2 * size - 2 - u : u;
}

// One pixel per thread: grey values smoothed a little, along rows, then along columns.
__global__ void __launch_bounds__(kGreyThreads) smooth_kernel(GreyJob job, GreyWorkspace work) {
  const int i = static_cast<int>(blockIdx.x * kGreyThreads + threadIdx.x), w = small_width(job), h = small_height(job);
  if (i >= w * h) return;
  const int u = i % w, v = i / w, left = mirrored(u - 1, w), right = mirrored(u + 1, w);
  float rows[3];
#pragma unroll
  for (int k = 0; k < 3; ++k) {
    const float* row = work.grey + static_cast<std::int64_t>(mirrored(v + k - 1, h)) * w;
    rows[k] = __fmaf_rn(row[u], job.blur_middle, __fmul_rn(__fadd_rn(row[left], row[right]), job.blur_side));
  }
  job.pixels[4 * static_cast<std::int64_t>(i)] =
      __fmaf_rn(__fadd_rn(rows[0], rows[2]), job.blur_side, __fmul_rn(rows[1], job.blur_middle));
}

// One pixel per thread: derivatives of the smoothed grey values (Sobel's), and whether the pixel is textured.
__global__ void __launch_bounds__(kGreyThreads) gradient_kernel(GreyJob job, GreyWorkspace work) {
  const int i = static_cast<int>(blockIdx.x * kGreyThreads + threadIdx.x), w = small_width(job), h = small_height(job);
  bool textured = false;
  if (i < w * h) {
    const int u = i % w, v = i / w, left = mirrored(u - 1, w), right = mirrored(u + 1, w);
    float across[3], along[3];
#pragma unroll
    for (int k = 0; k < 3; ++k) {
      const float* row = job.pixels + 4 * static_cast<std::int64_t>(mirrored(v + k - 1, h)) * w;
      const float a = row[4 * left], b = row[4 * u], c = row[4 * right];
      across[k] = __fadd_rn(c, -a);
      along[k] = __fadd_rn(__fmul_rn(0.25f, b), __fmul_rn(0.125f, __fadd_rn(a, c)));
    }
    const float du = __fadd_rn(__fmul_rn(0.25f, across[1]), __fmul_rn(0.125f, __fadd_rn(across[0], across[2])));
    const float dv = __fadd_rn(along[2], -along[0]);
    float* pixel = job.pixels + 4 * static_cast<std::int64_t>(i);
    pixel[1] = du, pixel[2] = dv;
    textured = pixel[3] > 0 && __fadd_rn(__fmul_rn(du, du), __fmul_rn(dv, dv)) > job.min_squared_gradient;
  }
  const unsigned bits = __ballot_sync(kAllLanes, textured);
  if (threadIdx.x % kWarp == 0) work.words[i / kWarp] = bits;
}

// Place among `wanted` of the textured pixel of rank `rank` of `found`, which are evenly thinned; -1: it is left out.
__device__ inline int thinned_place(int rank, int found, int wanted) {
  if (found <= wanted) return rank;
  if (wanted <= 1) return rank == 0 ? 0 : -1;
  if (rank == found - 1) return wanted - 1;
  const double step = static_cast<double>(found - 1) / (wanted - 1);
  const int near = static_cast<int>(rank / step);
  for (int place = max(near - 1, 0); place <= near + 1 && place < wanted - 1; ++place)
    if (static_cast<int>(place * step) == rank) return place;
  return -1;
}

// Writes the textured points, in the order of the image.
__global__ void __launch_bounds__(kGreyThreads) textured_points_kernel(GreyJob job, GreyWorkspace work, int word_count) {
  GGSLAM_SHARED unsigned room[kGreyThreads / kWarp];
  const int i = static_cast<int>(blockIdx.x * kGreyThreads + threadIdx.x), own = i / kWarp, w = small_width(job);
  const int first = static_cast<int>(blockIdx.x) * (kGreyThreads / kWarp);
  unsigned before = 0, all = 0;
  for (int k = static_cast<int>(threadIdx.x); k < word_count; k += kGreyThreads) {
    const unsigned bits = static_cast<unsigned>(__popc(work.words[k]));
    all += bits;
    if (k < first) before += bits;
  }
  int rank = static_cast<int>(sum_over_block<kGreyThreads>(before, room));
  const int found = static_cast<int>(sum_over_block<kGreyThreads>(all, room));
  if (i == 0) *job.count = min(found, job.most_points);
  for (int k = first; k < own; ++k) rank += __popc(work.words[k]);
  const std::uint32_t bit = std::uint32_t{1} << (i % kWarp);
  if (!(work.words[own] & bit)) return;
  rank += __popc(work.words[own] & (bit - 1));
  const int place = thinned_place(rank, found, job.most_points);
  if (place < 0) return;
  const float* pixel = job.pixels + 4 * static_cast<std::int64_t>(i);
  float* point = job.points + 3 * static_cast<std::int64_t>(place);
  const double z = static_cast<double>(pixel[3]);
  point[0] = static_cast<float>((i % w - job.cx) / job.fx * z);
  point[1] = static_cast<float>((i / w - job.cy) / job.fy * z);
  point[2] = pixel[3];
  job.intensity[place] = pixel[0];
}

// Starts to make the images, and the textured points if they are asked for.
inline void launch_greys(const GreyJob& job, cudaStream_t stream) {
  const GreyWorkspace work = grey_workspace(job);
  const int cells = small_width(job) * small_height(job);
  const std::int64_t blocks = blocks_for(cells, kGreyThreads);
  launch(shrink_kernel, blocks, kGreyThreads, stream, job, work);
  launch(smooth_kernel, blocks, kGreyThreads, stream, job, work);
  launch(gradient_kernel, blocks, kGreyThreads, stream, job, work);
  if (job.count != nullptr)
    launch(textured_points_kernel, blocks, kGreyThreads, stream, job, work, static_cast<int>(blocks) * (kGreyThreads / kWarp));
}

}  // namespace ggslam::cuda
