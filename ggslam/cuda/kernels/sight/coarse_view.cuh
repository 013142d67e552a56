// SPDX-License-Identifier: Apache-2.0
// A depth image's coarse view: the rules of native/src/sight/kernels/depth_places.cpp and of CoarseView.of in
// ggslam/sight/places.py, bit for bit. Each rounding is therefore written out.
#pragma once
#include "common/carver.cuh"
#include "common/host.cuh"
#include "abi/cuda/sight.hpp"
#include "common/block_median.cuh"

namespace ggslam::cuda {

constexpr int kPlaceThreads = 128;

struct EvidenceWorkspace {
  float* near;           // [h, w] of each place alone
  float* far;            // [h, w]
  std::uint8_t* whole;   // [h, w]
  std::uint32_t* words;  // [kMostEarlier, words]: a bit for each place that tells how much depths differ
  float* off;            // [kMostEarlier, h, w] how much, at some of them
  float* shares;         // [kMostEarlier] of the noise that is left in means
  std::size_t bytes;
};

__host__ __device__ inline int places_across(const MoverEvidenceJob& job) { return job.width / job.factor; }
__host__ __device__ inline int places_down(const MoverEvidenceJob& job) { return job.height / job.factor; }
__host__ __device__ inline int places_of(const MoverEvidenceJob& job) { return places_across(job) * places_down(job); }
// Words of a bit for each place, in whole blocks of threads.
__host__ __device__ inline int place_words(const MoverEvidenceJob& job) {
  return (places_of(job) + kPlaceThreads - 1) / kPlaceThreads * (kPlaceThreads / kWarp);
}

inline EvidenceWorkspace evidence_workspace(const MoverEvidenceJob& job) {
  const std::int64_t places = places_of(job);
  Carver carver(job.workspace);
  EvidenceWorkspace w;
  w.near = carver.take<float>(places), w.far = carver.take<float>(places);
  w.whole = carver.take<std::uint8_t>(places);
  w.words = carver.take<std::uint32_t>(static_cast<std::int64_t>(kMostEarlier) * place_words(job));
  w.off = carver.take<float>(kMostEarlier * places);
  w.shares = carver.take<float>(kMostEarlier);
  w.bytes = carver.used();
  return w;
}

// A view in its slot.
struct CoarseImages {
  float* depth;
  float* near;
  float* far;
  std::uint8_t* whole;
  std::uint8_t* smooth;
};

__device__ inline CoarseImages images_of(const MoverEvidenceJob& job, int slot) {
  const std::int64_t n = places_of(job);
  float* images = job.images + 3 * n * slot;
  std::uint8_t* flags = job.flags + 2 * n * slot;
  return {images, images + n, images + 2 * n, flags, flags + n};
}

// A row or column as if the image were mirrored at its borders, without repeating them.
__device__ inline int mirrored_far(int i, int count) {
  if (count == 1) return 0;
  while (i < 0 || i >= count) i = i < 0 ? -i : 2 * (count - 1) - i;
  return i;
}

struct WindowSums {
  float count, mean, spread;
};

// Means over the window about a place: sums down the columns first, then along the row.
__device__ inline WindowSums window_sums(const MoverEvidenceJob& job, int u, int v) {
  double total = 0, squares = 0;
  float count = 0;
#pragma unroll 1
  for (int x = u - job.reach; x <= u + job.reach; ++x) {
    const int column = mirrored_far(x, job.width);
    double column_total = 0, column_squares = 0;
#pragma unroll 1
    for (int y = v - job.reach; y <= v + job.reach; ++y) {
      const float z = job.depth[static_cast<std::int64_t>(mirrored_far(y, job.height)) * job.width + column];
      column_total += static_cast<double>(z), column_squares += static_cast<double>(__fmul_rn(z, z));
      count += z > 0 ? 1.0f : 0.0f;
    }
    total += column_total, squares += column_squares;
  }
  const float known = max(count, 1.0f), mean = static_cast<float>(total) / known;
  return {count, mean, __fadd_rn(static_cast<float>(squares) / known, -__fmul_rn(mean, mean))};
}

// One place per thread: its depth, and what it shows by itself.
__global__ void __launch_bounds__(kPlaceThreads) coarse_places_kernel(MoverEvidenceJob job, EvidenceWorkspace work) {
  const int i = static_cast<int>(blockIdx.x * kPlaceThreads + threadIdx.x), w = places_across(job);
  if (i == 0) job.found->novel = 0;
  if (i < 12) job.found->pose[i] = job.pose != nullptr ? job.pose[i] : job.given_pose[i];
  if (i >= places_of(job)) return;
  const int left = i % w * job.factor, top = i / w * job.factor, u = left + job.factor / 2, v = top + job.factor / 2;
  const WindowSums sums = window_sums(job, u, v);
  const float nothing = __uint_as_float(0x7f800000u);
  float nearest = nothing, farthest = -nothing, least = nothing;
  for (int y = top; y < top + job.factor; ++y)
    for (int x = left; x < left + job.factor; ++x) {
      const float z = job.depth[static_cast<std::int64_t>(y) * job.width + x];
      nearest = min(nearest, z > 0 ? z : nothing), farthest = max(farthest, z), least = min(least, z);
    }
  const float square = __fmul_rn(__fmul_rn(static_cast<float>(job.margin.square), sums.mean), sums.mean);
  const float limit = __fmul_rn(job.smooth_sigmas, __fadd_rn(static_cast<float>(job.margin.constant), square));
  const bool smooth = sums.count >= job.least_known && sums.spread < __fmul_rn(limit, limit);
  const CoarseImages view = images_of(job, job.slot);
  view.depth[i] = smooth ? sums.mean : job.depth[static_cast<std::int64_t>(v) * job.width + u];
  view.smooth[i] = smooth;
  work.near[i] = smooth ? sums.mean : nearest, work.far[i] = smooth ? sums.mean : farthest;
  work.whole[i] = least > 0 || smooth;
}

// One place per thread: the bounds of depth about it.
__global__ void __launch_bounds__(kPlaceThreads) coarse_bounds_kernel(MoverEvidenceJob job, EvidenceWorkspace work) {
  const int i = static_cast<int>(blockIdx.x * kPlaceThreads + threadIdx.x), w = places_across(job), h = places_down(job);
  if (i >= w * h) return;
  const int column = i % w, row = i / w;
  float near = __uint_as_float(0x7f800000u), far = -near;
  bool whole = column > 0 && row > 0 && column < w - 1 && row < h - 1;  // what is about others is not in the image
  for (int y = max(row - 1, 0); y <= min(row + 1, h - 1); ++y)
    for (int x = max(column - 1, 0); x <= min(column + 1, w - 1); ++x) {
      const int at = y * w + x;
      near = min(near, work.near[at]), far = max(far, work.far[at]), whole = whole && work.whole[at];
    }
  const CoarseImages view = images_of(job, job.slot);
  view.near[i] = near, view.far[i] = far, view.whole[i] = whole;
}

}  // namespace ggslam::cuda
