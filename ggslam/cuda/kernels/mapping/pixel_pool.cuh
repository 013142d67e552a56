// SPDX-License-Identifier: Apache-2.0
// Which pixels of a keyframe's mask identity learning looks at: ggslam/mapping/cpu/pixel_pool.py on the device.
//
// There, a share of the pixels is drawn at the boundaries of objects, the rest anywhere, in both cases first an object,
// then a pixel of it. Drawn one by one, that is one distribution over the pixels. Here it is written down as whole
// numbers per pixel, proportional to their odds; their running sum, in which a random number is looked up, is then the
// same in every run, whatever the order of additions.
#pragma once
#include "abi/cuda/mapping.hpp"
#include "common/carver.cuh"
#include "common/random.cuh"
#include "common/sorting.cuh"

namespace ggslam::cuda {

constexpr int kObjectIds = 65536;
constexpr int kPoolThreads = 256, kTotalThreads = 1024;
constexpr double kOddsOfAll = 4503599627370496.0;  // 2^52: even a billion pixels keep six digits of their odds

struct PoolWorkspace {
  std::int32_t* counts;  // [2, kObjectIds], pixels of each object; then only those at boundaries
  double* per_pixel;     // [2, kObjectIds], odds of one pixel of each object, by either way of drawing
  std::int64_t *odds, *sums;  // [H, W], of each pixel, and their running sum
  void* scratch;
  std::size_t bytes, scratch_bytes;
};

inline PoolWorkspace pool_workspace(void* block, const PixelPoolJob& job) {
  const std::int64_t pixels = static_cast<std::int64_t>(job.height) * job.width;
  Carver carver(block);
  PoolWorkspace w;
  w.counts = carver.take<std::int32_t>(2 * kObjectIds);
  w.per_pixel = carver.take<double>(2 * kObjectIds);
  for (std::int64_t** part : {&w.odds, &w.sums}) *part = carver.take<std::int64_t>(pixels);
  w.scratch_bytes = long_sum_bytes(pixels);
  w.scratch = carver.take<char>(static_cast<std::int64_t>(w.scratch_bytes));
  w.bytes = carver.used();
  return w;
}

__device__ inline std::int32_t current_id(const PixelPoolJob& job, std::int64_t pixel) {
  return job.alias[job.mask[pixel]];
}

// Whether a pixel of another object lies beside, above or below.
__device__ inline bool is_at_boundary(const PixelPoolJob& job, std::int64_t pixel, std::int32_t id) {
  const int x = static_cast<int>(pixel % job.width), y = static_cast<int>(pixel / job.width);
  return (x > 0 && current_id(job, pixel - 1) != id) || (x + 1 < job.width && current_id(job, pixel + 1) != id) ||
         (y > 0 && current_id(job, pixel - job.width) != id) ||
         (y + 1 < job.height && current_id(job, pixel + job.width) != id);
}

// Counts an id for each lane that `counted` says so of. Neighbours mostly are of one object: one addition serves them.
__device__ inline void count_ids(std::int32_t* counts, std::int32_t id, bool counted) {
  const unsigned lanes = __ballot_sync(kAllLanes, counted);
  if (lanes == 0) return;
  const int leader = __ffs(static_cast<int>(lanes)) - 1;
  const std::int32_t common = __shfl_sync(kAllLanes, id, leader);
  const unsigned same = __ballot_sync(kAllLanes, counted && id == common);
  if (static_cast<int>(threadIdx.x) % kWarp == leader) atomicAdd(counts + common, __popc(same));
  else if (counted && id != common) atomicAdd(counts + id, 1);
}

__global__ void __launch_bounds__(kPoolThreads) count_objects_kernel(PixelPoolJob job, PoolWorkspace w) {
  const std::int64_t pixel = static_cast<std::int64_t>(blockIdx.x) * kPoolThreads + threadIdx.x;
  const bool inside = pixel < static_cast<std::int64_t>(job.height) * job.width;
  const std::int32_t id = inside ? current_id(job, pixel) : 0;
  count_ids(w.counts, id, id != 0);
  count_ids(w.counts + kObjectIds, id, id != 0 && is_at_boundary(job, pixel, id));
}

// The sum of a value over a block of kTotalThreads, in a fixed order; the same for all its threads.
__device__ inline double total_over_block(double value) {
  GGSLAM_SHARED double of_warps[kTotalThreads / kWarp];
  for (int bits = kWarp / 2; bits > 0; bits /= 2) value += __shfl_xor_sync(kAllLanes, value, bits);
  if (threadIdx.x % kWarp == 0) of_warps[threadIdx.x / kWarp] = value;
  __syncthreads();
  double sum = 0.0;
  for (const double part : of_warps) sum += part;
  __syncthreads();
  return sum;
}

// Odds of a pixel of each object. One block.
__global__ void __launch_bounds__(kTotalThreads) object_odds_kernel(PixelPoolJob job, PoolWorkspace w) {
  double totals[2];
#pragma unroll
  for (int way = 0; way < 2; ++way) {
    const std::int32_t* counts = w.counts + way * kObjectIds;
    double sum = 0.0;
    for (int id = threadIdx.x; id < kObjectIds; id += kTotalThreads)
      if (counts[id] > 0) sum += pow(static_cast<double>(counts[id]), 1.0 - job.balance);
    totals[way] = total_over_block(sum);
  }
  const double at_boundaries = totals[1] > 0.0 ? job.boundary : 0.0;  // where there are none, all are drawn anywhere
  const double shares[2] = {1.0 - at_boundaries, at_boundaries};
#pragma unroll
  for (int way = 0; way < 2; ++way) {
    const std::int32_t* counts = w.counts + way * kObjectIds;
    for (int id = threadIdx.x; id < kObjectIds; id += kTotalThreads) {
      const double count = static_cast<double>(counts[id]);
      w.per_pixel[way * kObjectIds + id] = count > 0.0 ? shares[way] * pow(count, -job.balance) / totals[way] : 0.0;
    }
  }
}

__global__ void __launch_bounds__(kPoolThreads) pixel_odds_kernel(PixelPoolJob job, PoolWorkspace w) {
  const std::int64_t pixel = static_cast<std::int64_t>(blockIdx.x) * kPoolThreads + threadIdx.x;
  if (pixel >= static_cast<std::int64_t>(job.height) * job.width) return;
  const std::int32_t id = current_id(job, pixel);
  double odds = 0.0;
  if (id != 0) {
    odds = w.per_pixel[id];
    if (is_at_boundary(job, pixel, id)) odds += w.per_pixel[kObjectIds + id];
  }
  w.odds[pixel] = static_cast<std::int64_t>(odds * kOddsOfAll);
}

// Looks a random number up in the running sum: the first pixel whose sum is above it.
__global__ void __launch_bounds__(kPoolThreads) draw_pixels_kernel(PixelPoolJob job, PoolWorkspace w) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kPoolThreads + threadIdx.x;
  if (i >= job.drawn) return;
  const std::int64_t last = static_cast<std::int64_t>(job.height) * job.width - 1, total = w.sums[last];
  std::int64_t wanted = static_cast<std::int64_t>(random_number(job.seed, job.draw, i) * static_cast<double>(total));
  if (wanted > total - 1) wanted = total - 1;
  std::int64_t low = 0, high = last;
  while (low < high) {
    const std::int64_t middle = (low + high) / 2;
    if (w.sums[middle] > wanted) high = middle;
    else low = middle + 1;
  }
  job.pixels[i] = static_cast<std::int32_t>(low);
  job.vote_weights[i] =
      total > 0 ? static_cast<float>(static_cast<double>(total) / static_cast<double>(w.odds[low])) : 0.0f;
}

// Divides the votes' weights by their mean. One block.
__global__ void __launch_bounds__(kTotalThreads) even_out_weights_kernel(PixelPoolJob job) {
  double sum = 0.0;
  for (int i = static_cast<int>(threadIdx.x); i < job.drawn; i += kTotalThreads)
    sum += static_cast<double>(job.vote_weights[i]);
  const float mean = fmaxf(static_cast<float>(total_over_block(sum) / job.drawn), 1e-30f);
  for (int i = static_cast<int>(threadIdx.x); i < job.drawn; i += kTotalThreads) job.vote_weights[i] /= mean;
}

}  // namespace ggslam::cuda
