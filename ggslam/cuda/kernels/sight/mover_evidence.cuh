// SPDX-License-Identifier: Apache-2.0
// A coarse view against earlier ones: the rules of native/src/sight/kernels/places_evidence.cpp and of measured_share in
// places_api.cpp. The core's compiler joins operations as it likes, so results may differ by rounding.
#pragma once
#include "sight/coarse_view.cuh"

namespace ggslam::cuda {

// A place in an earlier view.
struct PlaceThere {
  float u, v, z;
  int at;  // -1: outside
  bool known, smooth;
};

// Rows of [R t] from the camera of the new view to that of an earlier one.
__device__ inline void earlier_from_view(const MoverEvidenceJob& job, int k, float (&T)[12]) {
  const double* A = job.T_camera_world[k];
  const double* B = job.found->pose;
  for (int r = 0; r < 3; ++r) {
    for (int c = 0; c < 3; ++c)
      T[4 * r + c] = static_cast<float>(A[4 * r] * B[c] + A[4 * r + 1] * B[3 + c] + A[4 * r + 2] * B[6 + c]);
    T[4 * r + 3] = static_cast<float>(A[4 * r] * B[9] + A[4 * r + 1] * B[10] + A[4 * r + 2] * B[11] + A[4 * r + 3]);
  }
}

__device__ inline PlaceThere find_place(const MoverEvidenceJob& job, const CoarseImages& view,
                                        const CoarseImages& earlier, const float (&T)[12], int i) {
  constexpr float kNearest = 1e-3f;  // metres before the camera
  const int w = places_across(job), h = places_down(job);
  const float fx = static_cast<float>(job.fx), fy = static_cast<float>(job.fy);
  const float cx = static_cast<float>(job.cx), cy = static_cast<float>(job.cy);
  const float d = view.depth[i];
  const float x = (static_cast<float>(i % w) - cx) / fx * d, y = (static_cast<float>(i / w) - cy) / fy * d;
  const float qx = T[0] * x + T[1] * y + T[2] * d + T[3], qy = T[4] * x + T[5] * y + T[6] * d + T[7];
  PlaceThere place;
  place.z = T[8] * x + T[9] * y + T[10] * d + T[11];
  const float ahead = place.z > kNearest ? place.z : kNearest;
  place.u = fx * qx / ahead + cx, place.v = fy * qy / ahead + cy;
  const bool inside = d > 0 && place.z > kNearest && place.u >= -0.5f && place.v >= -0.5f &&
                      place.u < static_cast<float>(w) - 0.5f && place.v < static_cast<float>(h) - 0.5f;
  place.at = inside ? static_cast<int>(place.v + 0.5f) * w + static_cast<int>(place.u + 0.5f) : -1;
  place.known = inside && earlier.whole[place.at];
  place.smooth = place.known && earlier.smooth[place.at] && view.smooth[i];
  return place;
}

// Standard deviation of a pixel's depth at depth z, metres.
__device__ inline float depth_sigma(const SightMargin& m, float z) {
  return static_cast<float>(m.constant) + static_cast<float>(m.square) * z * z;
}

// One place of one earlier view per thread: a bit, whether it tells how much depths of one surface differ.
__global__ void __launch_bounds__(kPlaceThreads) telling_places_kernel(MoverEvidenceJob job, EvidenceWorkspace work) {
  const int blocks = place_words(job) / (kPlaceThreads / kWarp), k = static_cast<int>(blockIdx.x) / blocks;
  const int i = static_cast<int>(blockIdx.x) % blocks * kPlaceThreads + static_cast<int>(threadIdx.x);
  bool tells = false;
  if (i < places_of(job)) {
    float T[12];
    earlier_from_view(job, k, T);
    const CoarseImages view = images_of(job, job.slot), earlier = images_of(job, job.slots[k]);
    tells = find_place(job, view, earlier, T, i).smooth && !(job.moved != nullptr && job.moved[i]);
  }
  const unsigned bits = __ballot_sync(kAllLanes, tells);
  if (threadIdx.x % kWarp == 0) work.words[static_cast<std::int64_t>(k) * place_words(job) + i / kWarp] = bits;
}

// How far depth at a place of the earlier view, between its four pixels, is from that of the point there.
__device__ inline float off_by(const MoverEvidenceJob& job, const float* depth, const PlaceThere& place) {
  const int w = places_across(job), h = places_down(job);
  const int left = min(max(static_cast<int>(place.u), 0), max(0, w - 2));
  const int top = min(max(static_cast<int>(place.v), 0), max(0, h - 2));
  const int right = min(left + 1, w - 1), low = min(top + 1, h - 1);
  const float a = place.u - static_cast<float>(left), b = place.v - static_cast<float>(top);
  const float upper = (1 - a) * depth[top * w + left] + a * depth[top * w + right];
  const float lower = (1 - a) * depth[low * w + left] + a * depth[low * w + right];
  return fabsf((1 - b) * upper + b * lower - place.z) / depth_sigma(job.margin, place.z);
}

// Sums of `value` over the threads before each one, and over all of the block.
__device__ inline unsigned sum_before(unsigned value, unsigned (&sums)[2][kMedianThreads], unsigned* all) {
  const int thread = static_cast<int>(threadIdx.x);
  int from = 0;
  sums[0][thread] = value;
  __syncthreads();
  for (int step = 1; step < kMedianThreads; step *= 2, from ^= 1) {
    sums[from ^ 1][thread] = sums[from][thread] + (thread >= step ? sums[from][thread - step] : 0);
    __syncthreads();
  }
  *all = sums[from][kMedianThreads - 1];
  return sums[from][thread] - value;
}

// One block for each earlier view: how large differences between means are, in standard deviations of a pixel.
__global__ void __launch_bounds__(kMedianThreads) noise_share_kernel(MoverEvidenceJob job, EvidenceWorkspace work) {
  GGSLAM_SHARED unsigned room[kMedianThreads / kWarp];
  GGSLAM_SHARED unsigned sums[2][kMedianThreads];
  GGSLAM_SHARED float T[12];  // registers are few in a block this large
  const int k = static_cast<int>(blockIdx.x), words = place_words(job), thread = static_cast<int>(threadIdx.x);
  const std::uint32_t* bits = work.words + static_cast<std::int64_t>(k) * words;
  float* off = work.off + static_cast<std::int64_t>(k) * places_of(job);
  const int each = (words + kMedianThreads - 1) / kMedianThreads;
  const int begin = min(thread * each, words), end = min(begin + each, words);
  unsigned own = 0, all = 0;
  if (thread == 0) earlier_from_view(job, k, T);
  for (int word = begin; word < end; ++word) own += static_cast<unsigned>(__popc(bits[word]));
  unsigned seen = sum_before(own, sums, &all);
  const CoarseImages view = images_of(job, job.slot), earlier = images_of(job, job.slots[k]);
  const unsigned every = static_cast<unsigned>(job.every);
  for (int word = begin; word < end; ++word)
    for (std::uint32_t rest = bits[word]; rest != 0; rest &= rest - 1, ++seen)
      if (seen % every == 0)
        off[seen / every] =
            off_by(job, earlier.depth, find_place(job, view, earlier, T, kWarp * word + __ffs(static_cast<int>(rest)) - 1));
  __syncthreads();
  const int count = static_cast<int>((all + every - 1) / every);
  const float median = block_median(count, count, [&](int i) { return __float_as_uint(off[i]); }, room);
  if (thread != 0) return;
  constexpr float kNormal = 0.6745f;  // the median of a normal distribution's absolute values
  const float share = min(max(job.nearest * median / kNormal, job.least_share), job.rough);
  work.shares[k] = count == 0 || count < job.fewest ? job.rough : share;
}

struct PlaceEvidence {
  std::uint8_t passed, clearly, surely, same, known, stayed, left;
};

// Adds what an earlier view says of a place.
__device__ inline void add_evidence(const MoverEvidenceJob& job, int k, float share, const CoarseImages& earlier,
                                    const PlaceThere& place, PlaceEvidence* sum) {
  if (place.at < 0) return;
  const SightMargin& m = job.margin;
  const float z = place.z, of_distance = static_cast<float>(m.share) * z, least = static_cast<float>(m.least);
  const float noise = place.smooth ? share : job.rough;
  const float slack =
      (of_distance > least ? of_distance : least) + static_cast<float>(m.sigmas) * noise * depth_sigma(m, z);
  const float near = earlier.near[place.at], far = earlier.far[place.at];
  const bool beyond = place.known && near > z + 2 * slack, same = near < z + slack && far > z - slack;
  const bool otherwise = place.known && !same;
  sum->passed += place.known && near > z + slack;
  sum->clearly += beyond, sum->surely += beyond && place.smooth, sum->same += same;
  sum->known |= same || otherwise;
  sum->stayed |= same && (job.parts[k] & kStayed) != 0;
  sum->left |= otherwise && (job.parts[k] & kLeft) != 0;
}

// One place per thread: what all earlier views say of it, and how many places are novel.
__global__ void __launch_bounds__(kPlaceThreads) judge_places_kernel(MoverEvidenceJob job, EvidenceWorkspace work) {
  const int i = static_cast<int>(blockIdx.x * kPlaceThreads + threadIdx.x), n = places_of(job);
  PlaceEvidence sum = {0, 0, 0, 0, 0, 0, 0};
  bool novel = false;
  if (i < n) {
    const CoarseImages view = images_of(job, job.slot);
    for (int k = 0; k < job.count; ++k) {
      float T[12];
      earlier_from_view(job, k, T);
      const CoarseImages earlier = images_of(job, job.slots[k]);
      add_evidence(job, k, work.shares[k], earlier, find_place(job, view, earlier, T, i), &sum);
    }
    const std::uint8_t planes[kEvidencePlanes] = {sum.passed, sum.clearly, sum.surely, sum.same,
                                                  sum.known,  sum.stayed,  sum.left};
    for (int p = 0; p < kEvidencePlanes; ++p) job.planes[static_cast<std::int64_t>(p) * n + i] = planes[p];
    novel = sum.passed + sum.surely >= job.fewest_passed;
  }
  const int found = __syncthreads_count(novel);
  if (threadIdx.x == 0 && found > 0) atomicAdd(&job.found->novel, found);
}

}  // namespace ggslam::cuda
