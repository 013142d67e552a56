// SPDX-License-Identifier: Apache-2.0
// The C interface of a new keyframe. Only starts work on the caller's stream. Functions return 0 or a cudaError_t.
#include "abi/cuda/seen_map.hpp"

#include "common/host.cuh"
#include "mapping/keyframe_look.cuh"

using namespace ggslam::cuda;

namespace {

int label(const Rendering& rendering, const SeenLabelJob& job) {
  if (const int status = ggslam_cuda_terms_collect(&job.terms, &rendering, job.pixels, job.min_weight)) return status;
  if (const int status = ggslam_cuda_vote_labels(&job.votes)) return status;
  return ggslam_cuda_terms_label(&job.terms, job.votes.labels, job.votes.count, job.ids, job.shares);
}

int look_at(const KeyframeLookJob& job) {
  return on_device(job.device, [&] {
    const cudaStream_t stream = static_cast<cudaStream_t>(job.stream);
    const std::int64_t pixels = static_cast<std::int64_t>(job.height) * job.width;
    launch(keyframe_look_kernel, blocks_for(pixels, kLookThreads), kLookThreads, stream, job);
    if (job.ratios != nullptr) launch(brightness_kernel, 3, kMedianThreads, stream, job);
    return cudaSuccess;
  });
}

}  // namespace

GGSLAM_EXPORT int ggslam_cuda_see_map(const Rendering* rendering, const SeenLabelJob* labels,
                                      const KeyframeLookJob* look, const InsertionJob* selection) {
  if (labels != nullptr)
    if (const int status = label(*rendering, *labels)) return status;
  if (const int status = look_at(*look)) return status;
  return ggslam_cuda_insertion_select(selection);
}

GGSLAM_EXPORT int ggslam_cuda_insert_rows(const FillJob* fill, const InsertionJob* built, const BirthLabelJob* births) {
  if (const int status = ggslam_cuda_fill_words(fill)) return status;
  if (const int status = ggslam_cuda_insertion_build(built)) return status;
  return births != nullptr ? ggslam_cuda_birth_labels(births) : 0;
}
