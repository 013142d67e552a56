// SPDX-License-Identifier: Apache-2.0
// The C interface of sampled compositing. Only starts work on the caller's stream; functions return 0 or a cudaError_t.
// The caller has checked sizes; pixels and Gaussians out of range are passed over.
#include "common/carver.cuh"
#include "common/host.cuh"
#include "common/sorting.cuh"
#include "rendering/pixel_terms_collect.cuh"
#include "rendering/pixel_terms_use.cuh"

namespace ggslam::cuda {
namespace {

cudaStream_t stream_of(const PixelTerms& terms) { return static_cast<cudaStream_t>(terms.stream); }

// Memory that sorting works in.
struct TermSorting {
  std::uint32_t *keys, *places;
  void* scratch;
  std::size_t scratch_bytes, bytes;
};

TermSorting term_sorting(void* block, std::int64_t entries) {
  Carver carver(block);
  TermSorting w;
  w.keys = carver.take<std::uint32_t>(entries);
  w.places = carver.take<std::uint32_t>(entries);
  w.scratch_bytes = sorting_bytes(entries);
  w.scratch = carver.take<char>(static_cast<std::int64_t>(w.scratch_bytes));
  w.bytes = carver.used();
  return w;
}

// Starts a kernel that gives each place of the sorted terms a warp.
template <class Kernel, class... Arguments>
int visit_sorted(const PixelTerms& terms, const TermsByGaussian& sorted, Kernel kernel, const Arguments&... arguments) {
  return on_device(terms.device, [&] {
    launch(kernel, blocks_for(sorted.size, kTermWarps), kTermThreads, stream_of(terms), terms, sorted, arguments...);
    return cudaSuccess;
  });
}

}  // namespace
}  // namespace ggslam::cuda

using namespace ggslam::cuda;

GGSLAM_EXPORT int ggslam_cuda_terms_collect(const PixelTerms* out, const Rendering* r, const std::int32_t* pixels,
                                            float min_weight) {
  return on_device(out->device, [&] {
    const Grid grid = make_grid(r->view);
    const GaussianWorkspace w =
        gaussian_workspace(r->gaussian_workspace, r->gaussians.count, r->gaussian_sorting_bytes);
    const PairWorkspace pairs = pair_workspace(r->pair_workspace, r->pair_capacity, r->pair_sorting_bytes);
    launch(collect_terms_kernel, blocks_for(out->pixels, kTermWarps), kTermThreads, stream_of(*out), grid, w.splats,
           pairs, pixel_workspace(r->pixel_workspace, grid), pixels, min_weight, *out);
    return cudaSuccess;
  });
}

GGSLAM_EXPORT int ggslam_cuda_terms_of_gaussians(const PixelTerms* out, const std::int32_t* rows) {
  return on_device(out->device, [&] {
    launch(single_terms_kernel, blocks_for(out->pixels * out->capacity, kTermThreads), kTermThreads, stream_of(*out), rows, *out);
    return cudaSuccess;
  });
}

GGSLAM_EXPORT int ggslam_cuda_terms_blend(const PixelTerms* terms, const float* features, std::int64_t count,
                                          int channels, float* out) {
  return on_device(terms->device, [&] {
    launch(blend_terms_kernel, blocks_for(terms->pixels * channels, kTermThreads), kTermThreads, stream_of(*terms),
           *terms, features, count, channels, out);
    return cudaSuccess;
  });
}

GGSLAM_EXPORT int ggslam_cuda_terms_label(const PixelTerms* terms, const std::int32_t* labels, std::int64_t count,
                                          std::int32_t* ids, float* shares) {
  return on_device(terms->device, [&] {
    launch(label_terms_kernel, blocks_for(terms->pixels, kTermWarps), kTermThreads, stream_of(*terms), *terms, labels,
           count, ids, shares);
    return cudaSuccess;
  });
}

GGSLAM_EXPORT std::int64_t ggslam_cuda_terms_sorting_bytes(std::int64_t entries) {
  return static_cast<std::int64_t>(term_sorting(nullptr, entries).bytes);
}

GGSLAM_EXPORT int ggslam_cuda_terms_sort(const PixelTerms* terms, const TermsByGaussian* sorted, void* workspace) {
  return on_device(terms->device, [&] {
    if (sorted->size == 0) return cudaSuccess;
    const TermSorting w = term_sorting(workspace, sorted->size);
    launch(term_keys_kernel, blocks_for(sorted->size, kTermThreads), kTermThreads, stream_of(*terms), *terms,
           sorted->count, w.keys, w.places);
    return sort_pairs(w.scratch, w.scratch_bytes, w.keys, sorted->gaussians, w.places, sorted->places,
                      sorted->size, bits_of(static_cast<std::uint32_t>(sorted->count)), stream_of(*terms));
  });
}

GGSLAM_EXPORT int ggslam_cuda_terms_step(const PixelTerms* terms, const TermsByGaussian* sorted, const float* gradient,
                                         int channels, const AdamStep* adam) {
  int width = 1;
  while (width < channels && width < kWarp) width *= 2;
  return visit_sorted(*terms, *sorted, step_terms_kernel, gradient, channels, width, *adam);
}

GGSLAM_EXPORT int ggslam_cuda_terms_vote(const PixelTerms* terms, const TermsByGaussian* sorted,
                                         const std::int32_t* labels, const float* pixel_weights,
                                         std::int64_t labelled, std::int32_t* vote_ids, float* vote_weights) {
  return visit_sorted(*terms, *sorted, vote_terms_kernel, labels, pixel_weights, labelled, vote_ids, vote_weights);
}

GGSLAM_EXPORT int ggslam_cuda_terms_sum(const PixelTerms* terms, const TermsByGaussian* sorted,
                                        const float* pixel_weights, float* sums) {
  return visit_sorted(*terms, *sorted, sum_terms_kernel, pixel_weights, sums);
}
