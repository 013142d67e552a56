// SPDX-License-Identifier: Apache-2.0
// The CUDA kernels' rasterizer and sampled compositing. Pointers lead to device memory, those of the core's structures,
// too. Calls only start work on the caller's stream, but for ggslam_cuda_wait; those with a status return 0 or a
// cudaError_t.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/core/rendering.hpp"
#include "abi/export.hpp"

namespace ggslam::cuda {

// One rendering: what to render, where to, and the device memory to work in (see workspace.cuh).
struct Rendering {
  GaussianArrays gaussians;
  CameraView view;
  const float* pose;  // camera_world on the device, unchanged until all that was started is done; null: the view's own
  RenderTargets targets;
  void *gaussian_workspace, *pair_workspace, *pixel_workspace;
  std::int64_t pair_capacity;  // pairs of a Gaussian and a tile that pair_workspace has room for
  std::int64_t gaussian_sorting_bytes, pair_sorting_bytes;  // scratch for sorting, as set by ggslam_cuda_plan
  std::int32_t* overflowed;  // on the device, [1]: becomes 1 if there was too little room for pairs, else 0
  std::int64_t* overflows;   // on the device, [1]: then becomes one more; may be null
  std::int64_t* most_pairs;  // on the device, [1]: becomes the number of pairs where that is larger; may be null
  void* stream;
  std::int32_t device;
};

// Sizes of the memory that a rendering works in.
struct Sizes {
  std::int64_t gaussian_workspace, pair_workspace, pixel_workspace, gradient_rows;  // bytes
};

enum AdamGroup { kMeans, kQuaternions, kLogScales, kOpacityLogits, kShConstant, kShRest, kFeatures, kAdamGroups };

// One step of the optimizer that is fused into the backward pass.
struct AdamStep {
  AdamArrays means, quaternions, log_scales, opacity_logits, sh, features;
  std::int32_t* updates;  // [N], of each Gaussian so far
  const float* current_rates;  // on the device, [kAdamGroups], read when the step is made, in place of `rates`; may be null
  float rates[kAdamGroups];
  std::int32_t decayed_groups;  // bit g: the rate of group g decays
  std::int32_t falling_groups;  // bit g: it falls instead
  float log_decay, decay_floor; // rate * max(decay_floor, decay^(u - 1)) at the u-th update
  float fall_rate, fall_floor;  // rate * max(fall_floor, 1 / sqrt(1 + (u - 1) fall_rate))
  float beta1, beta2, log_beta1, log_beta2, epsilon;
};

// The terms of P pixels: the first counts[p] of row p are in use, front to back; the rest are zero.
struct PixelTerms {
  std::int64_t pixels;
  std::int32_t* gaussians;  // [P, capacity]
  float* weights;           // [P, capacity]
  std::int32_t* counts;     // [P]
  void* stream;
  std::int32_t capacity;
  std::int32_t device;
};

// All places of the terms, sorted by Gaussian; those of one Gaussian are in the order of the pixels. Places not in use
// come last, under the number `count`.
struct TermsByGaussian {
  std::uint32_t* gaussians;  // [P * capacity]
  std::uint32_t* places;     // [P * capacity], p * capacity + i
  std::int64_t size;         // P * capacity
  std::int64_t count;        // Gaussians in the map
};

}  // namespace ggslam::cuda

// A counter receives the totals of projections on the host.
GGSLAM_EXPORT int ggslam_cuda_counter_create(int device, void** counter);
GGSLAM_EXPORT void ggslam_cuda_counter_destroy(void* counter);

// Sets the rendering's sizes of sorting scratch and tells how much memory its blocks need, for its pair_capacity.
GGSLAM_EXPORT int ggslam_cuda_plan(ggslam::cuda::Rendering* r, ggslam::cuda::Sizes* sizes);

// Projects, counts and sorts by depth. The totals will be in the counter, if one is given; needs the Gaussians' workspace
// only.
GGSLAM_EXPORT int ggslam_cuda_project(const ggslam::cuda::Rendering* r, void* counter);

// Waits for the counter's last projection; totals: visible Gaussians, pairs of a Gaussian and a tile.
GGSLAM_EXPORT int ggslam_cuda_wait(const void* counter, std::int64_t* totals);

// The largest number of pairs of the last kRecent projections, all those of one call of training being one of them. Does not wait: in the place of one that is still to come
// stands the number of an older one. Each number is written as a whole.
GGSLAM_EXPORT std::int64_t ggslam_cuda_recent_pairs(const void* counter);

// Lists pairs by tile and composites. May be called again for the same projection, with more room for pairs.
GGSLAM_EXPORT int ggslam_cuda_composite(const ggslam::cuda::Rendering* r);

// Both, for which the host need not know the number of pairs between them.
GGSLAM_EXPORT int ggslam_cuda_render(const ggslam::cuda::Rendering* r, void* counter);

// Differentiates a rendering, whose arrays and memory must still be there and unchanged. adam: null, or a step to make
// instead of writing gradients; it changes the arrays. row_memory: gradient_rows bytes.
GGSLAM_EXPORT int ggslam_cuda_backward(const ggslam::cuda::Rendering* r, const ggslam::ImageGradients* image_gradients,
                                       const ggslam::GaussianGradients* gradients, const ggslam::cuda::AdamStep* adam,
                                       float* row_memory);

// Terms of pixels [P] (row * width + column) of a rendering whose memory must still be there, without contributions below
// min_weight and those for which a row has no room.
GGSLAM_EXPORT int ggslam_cuda_terms_collect(const ggslam::cuda::PixelTerms* out, const ggslam::cuda::Rendering* r,
                                            const std::int32_t* pixels, float min_weight);

// Terms of pixels that show one Gaussian each, rows [P].
GGSLAM_EXPORT int ggslam_cuda_terms_of_gaussians(const ggslam::cuda::PixelTerms* out, const std::int32_t* rows);

// out [P, channels] = sum of weight times feature, for features [count, channels].
GGSLAM_EXPORT int ggslam_cuda_terms_blend(const ggslam::cuda::PixelTerms* terms, const float* features,
                                          std::int64_t count, int channels, float* out);

// The label with the largest rendering weight at each pixel, and its share of the pixel's weight, for labels [count].
GGSLAM_EXPORT int ggslam_cuda_terms_label(const ggslam::cuda::PixelTerms* terms, const std::int32_t* labels,
                                          std::int64_t count, std::int32_t* ids, float* shares);

// Bytes of memory that sorting so many places works in.
GGSLAM_EXPORT std::int64_t ggslam_cuda_terms_sorting_bytes(std::int64_t entries);

// Writes the arrays of `sorted`, whose size and count are set. workspace: terms_sorting_bytes bytes.
GGSLAM_EXPORT int ggslam_cuda_terms_sort(const ggslam::cuda::PixelTerms* terms,
                                         const ggslam::cuda::TermsByGaussian* sorted, void* workspace);

// One step of Adam on the features of the Gaussians in the terms; gradient [P, channels].
GGSLAM_EXPORT int ggslam_cuda_terms_step(const ggslam::cuda::PixelTerms* terms,
                                         const ggslam::cuda::TermsByGaussian* sorted, const float* gradient,
                                         int channels, const ggslam::cuda::AdamStep* adam);

// Adds to the votes [N, 4] of the Gaussians in the terms of the first `labelled` pixels.
GGSLAM_EXPORT int ggslam_cuda_terms_vote(const ggslam::cuda::PixelTerms* terms,
                                         const ggslam::cuda::TermsByGaussian* sorted, const std::int32_t* labels,
                                         const float* pixel_weights, std::int64_t labelled, std::int32_t* vote_ids,
                                         float* vote_weights);

// Sets sums [N], zero before, of the Gaussians in the terms.
GGSLAM_EXPORT int ggslam_cuda_terms_sum(const ggslam::cuda::PixelTerms* terms,
                                        const ggslam::cuda::TermsByGaussian* sorted, const float* pixel_weights,
                                        float* sums);
