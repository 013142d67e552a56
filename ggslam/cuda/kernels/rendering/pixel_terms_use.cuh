// SPDX-License-Identifier: Apache-2.0
// What is made of terms: features and labels at the pixels, gradients and votes at the Gaussians. Every sum has a fixed
// order, so results repeat bit for bit.
//
// What goes to the Gaussians goes by the terms sorted by Gaussian: a warp looks at each place of the sorted list, and
// the one at the first place of a Gaussian does the work for it, 32 terms at a time. The others end at once, which costs
// less than counting the Gaussians would.
#pragma once
#include "rendering/adam.cuh"
#include "rendering/pixel_terms.cuh"

namespace ggslam::cuda {

// out [P, channels] = sum of weight times feature, front to back. A thread per pixel and channel.
__global__ void __launch_bounds__(kTermThreads)
blend_terms_kernel(PixelTerms terms, const float* features, std::int64_t count, int channels, float* out) {
  const std::int64_t index = static_cast<std::int64_t>(blockIdx.x) * kTermThreads + threadIdx.x;
  if (index >= terms.pixels * channels) return;
  const std::int64_t p = index / channels;
  const int channel = static_cast<int>(index - p * channels), size = terms.counts[p];
  const std::int32_t* gaussians = terms.gaussians + p * terms.capacity;
  const float* weights = terms.weights + p * terms.capacity;
  float sum = 0.0f;
#pragma unroll 4
  for (int k = 0; k < size; ++k) {
    const std::int64_t row = gaussians[k];
    if (row >= 0 && row < count) sum += weights[k] * features[row * channels + channel];
  }
  out[index] = sum;
}

// The label with the largest sum of weights among a pixel's terms, and its share of the whole. A warp per pixel; each of
// the first 16 lanes sums up one label, in the order of their appearance. A seventeenth will not be the heaviest one.
__global__ void __launch_bounds__(kTermThreads)
label_terms_kernel(PixelTerms terms, const std::int32_t* labels, std::int64_t count, std::int32_t* ids, float* shares) {
  const int lane = threadIdx.x % kWarp;
  const std::int64_t p = static_cast<std::int64_t>(blockIdx.x) * kTermWarps + threadIdx.x / kWarp;
  if (p >= terms.pixels) return;  // the whole warp
  const int size = terms.counts[p];
  std::int32_t id = 0;
  float sum = 0.0f, whole = 0.0f;
  int distinct = 0;
  for (int first = 0; first < size; first += kWarp) {
    const bool given = first + lane < size;
    const std::int64_t place = p * terms.capacity + first + lane, row = given ? terms.gaussians[place] : -1;
    const float my_weight = given ? terms.weights[place] : 0.0f;
    const std::int32_t my_label = row >= 0 && row < count ? labels[row] : 0;
    for (int k = 0; k < min(size - first, kWarp); ++k) {
      const std::int32_t label = __shfl_sync(kAllLanes, my_label, k);
      const float weight = __shfl_sync(kAllLanes, my_weight, k);
      whole += weight;
      const bool known = __ballot_sync(kAllLanes, lane < distinct && id == label) != 0;
      if (!known && distinct < kDistinctLabels) {
        if (lane == distinct) id = label;
        ++distinct;
      }
      if (lane < distinct && id == label) sum += weight;
    }
  }
  // Weights are not negative, so their bits are in the order of their values.
  const int bits = lane < distinct ? static_cast<int>(__float_as_uint(sum)) : -1;
  const int highest = __reduce_max_sync(kAllLanes, bits);
  const int best = __ffs(static_cast<int>(__ballot_sync(kAllLanes, bits == highest))) - 1;
  if (lane != best) return;
  ids[p] = distinct == 0 ? 0 : id;
  shares[p] = distinct == 0 ? 0.0f : sum / whole;
}

// What places are sorted by. A thread per place.
__global__ void __launch_bounds__(kTermThreads)
term_keys_kernel(PixelTerms terms, std::int64_t count, std::uint32_t* keys, std::uint32_t* places) {
  const std::int64_t place = static_cast<std::int64_t>(blockIdx.x) * kTermThreads + threadIdx.x;
  if (place >= terms.pixels * terms.capacity) return;
  const std::int64_t p = place / terms.capacity, row = terms.gaussians[place];
  const bool used = place - p * terms.capacity < terms.counts[p] && row >= 0 && row < count;
  keys[place] = static_cast<std::uint32_t>(used ? row : count);
  places[place] = static_cast<std::uint32_t>(place);
}

// The place of the sorted list that this warp looks at, or -1 if it is not the first one of a Gaussian.
__device__ inline std::int64_t first_place_of_gaussian(const TermsByGaussian& sorted) {
  const std::int64_t at = static_cast<std::int64_t>(blockIdx.x) * kTermWarps + threadIdx.x / kWarp;
  if (at >= sorted.size || sorted.gaussians[at] >= sorted.count) return -1;
  return at > 0 && sorted.gaussians[at - 1] == sorted.gaussians[at] ? -1 : at;
}

// Calls visit(n, pixel, weight) for up to 32 terms at a time of the Gaussian whose terms start at `first`; the n first
// lanes have one each, the others weight 0. All lanes of the warp take part.
template <class Visit>
__device__ inline void visit_terms(const PixelTerms& terms, const TermsByGaussian& sorted, std::int64_t first,
                                   const Visit& visit) {
  const std::uint32_t gaussian = sorted.gaussians[first];
  for (std::int64_t at = first + threadIdx.x % kWarp;; at += kWarp) {
    const bool given = at < sorted.size && sorted.gaussians[at] == gaussian;
    const std::uint32_t place = given ? sorted.places[at] : 0;
    const unsigned lanes = __ballot_sync(kAllLanes, given);
    visit(__popc(lanes), place / static_cast<std::uint32_t>(terms.capacity), given ? terms.weights[place] : 0.0f);
    if (lanes != kAllLanes) return;
  }
}

// Adam on the features of the Gaussians in `terms`, their gradient being the sum of weight times gradient [P, channels].
// `width` lanes, a power of two, take one term's channels, so that 32 / width terms are added at a time.
__global__ void __launch_bounds__(kTermThreads)
step_terms_kernel(PixelTerms terms, TermsByGaussian sorted, const float* gradient, int channels, int width,
                  AdamStep adam) {
  const std::int64_t first = first_place_of_gaussian(sorted);
  if (first < 0) return;  // the whole warp
  const int lane = threadIdx.x % kWarp, channel = lane & (width - 1), at_a_time = kWarp / width, mine = lane / width;
  float low = 0.0f, high = 0.0f;  // of channels `channel` and channel + 32
  visit_terms(terms, sorted, first, [&](int n, std::uint32_t my_pixel, float my_weight) {
#pragma unroll 4
    for (int k = 0; k < n; k += at_a_time) {
      const std::int64_t pixel = __shfl_sync(kAllLanes, my_pixel, k + mine);
      const float weight = __shfl_sync(kAllLanes, my_weight, k + mine);
      const float* row = gradient + pixel * channels + channel;
      if (k + mine >= n) continue;
      if (channel < channels) low += weight * row[0];
      if (channel + kWarp < channels) high += weight * row[kWarp];
    }
  });
  for (int step = kWarp / 2; step >= width; step /= 2) low += __shfl_xor_sync(kAllLanes, low, step);
  const std::int64_t gaussian = sorted.gaussians[first];
  const std::int32_t update = adam.updates[gaussian] + 1;
  __syncwarp();  // all lanes have read it
  if (lane == 0) adam.updates[gaussian] = update;
  if (mine > 0) return;
  const AdamFactors factors = adam_factors(adam, update);
  const float size = step_size(adam, factors, kFeatures);
  const std::int64_t at = gaussian * channels + channel;
  if (channel < channels) step_parameter(adam, adam.features, at, low, size, factors.correction);
  if (channel + kWarp < channels) step_parameter(adam, adam.features, at + kWarp, high, size, factors.correction);
}

// Adds the weight of `label` to a Gaussian's slots. With every slot taken by other labels, the lightest one gives way
// and leaves its weight as the newcomer's head start (the space-saving sketch of Metwally et al. 2005).
__device__ inline void add_vote(std::int32_t (&ids)[kVoteSlots], float (&weights)[kVoteSlots], std::int32_t label,
                                float weight) {
  int slot = -1, lightest = 0;
  float least = weights[0];
#pragma unroll
  for (int s = 0; s < kVoteSlots; ++s) {
    if (slot < 0 && ids[s] == label) slot = s;
    if (weights[s] < least) least = weights[s], lightest = s;
  }
  if (slot < 0) slot = lightest;
#pragma unroll
  for (int s = 0; s < kVoteSlots; ++s)
    if (s == slot) ids[s] = label, weights[s] += weight;
}

// Adds the weights of the first L pixels, times those of the pixels [L] (null: 1), to the votes [N, slots] of their
// Gaussians under labels [L]; label 0 votes for nothing. The order of the pixels decides, so terms are taken one after
// another; every lane does the same.
__global__ void __launch_bounds__(kTermThreads)
vote_terms_kernel(PixelTerms terms, TermsByGaussian sorted, const std::int32_t* labels, const float* pixel_weights,
                  std::int64_t labelled, std::int32_t* vote_ids, float* vote_weights) {
  const std::int64_t first = first_place_of_gaussian(sorted);
  if (first < 0) return;  // the whole warp
  const std::int64_t at = static_cast<std::int64_t>(sorted.gaussians[first]) * kVoteSlots;
  std::int32_t ids[kVoteSlots];
  float weights[kVoteSlots];
#pragma unroll
  for (int s = 0; s < kVoteSlots; ++s) ids[s] = vote_ids[at + s], weights[s] = vote_weights[at + s];
  visit_terms(terms, sorted, first, [&](int n, std::uint32_t my_pixel, float my_weight) {
    const bool given = static_cast<int>(threadIdx.x % kWarp) < n && my_pixel < labelled;
    const std::int32_t my_label = given ? labels[my_pixel] : 0;
    const float my_vote = given && pixel_weights != nullptr ? pixel_weights[my_pixel] * my_weight : my_weight;
    for (unsigned left = __ballot_sync(kAllLanes, my_label != 0); left != 0; left &= left - 1) {
      const int lane = __ffs(static_cast<int>(left)) - 1;
      const std::int32_t label = __shfl_sync(kAllLanes, my_label, lane);
      add_vote(ids, weights, label, __shfl_sync(kAllLanes, my_vote, lane));
    }
  });
  if (threadIdx.x % kWarp != 0) return;
#pragma unroll
  for (int s = 0; s < kVoteSlots; ++s) vote_ids[at + s] = ids[s], vote_weights[at + s] = weights[s];
}

// sums [N] of each Gaussian's weights times those of the pixels [P] (null: 1), zero before.
__global__ void __launch_bounds__(kTermThreads)
sum_terms_kernel(PixelTerms terms, TermsByGaussian sorted, const float* pixel_weights, float* sums) {
  const std::int64_t first = first_place_of_gaussian(sorted);
  if (first < 0) return;  // the whole warp
  float sum = 0.0f;
  visit_terms(terms, sorted, first, [&](int, std::uint32_t pixel, float weight) {
    sum += pixel_weights != nullptr ? pixel_weights[pixel] * weight : weight;
  });
  for (int step = kWarp / 2; step > 0; step /= 2) sum += __shfl_xor_sync(kAllLanes, sum, step);
  if (threadIdx.x % kWarp == 0) sums[sorted.gaussians[first]] = sum;
}

}  // namespace ggslam::cuda
