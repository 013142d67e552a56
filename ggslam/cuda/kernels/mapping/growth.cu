// SPDX-License-Identifier: Apache-2.0
// The C interface of what happens to the map at keyframes. Only starts work on the caller's stream. Functions return 0
// or a cudaError_t; the caller has checked sizes and pointers.
#include "mapping/growth.cuh"

#include <algorithm>

#include "common/host.cuh"

using namespace ggslam::cuda;

namespace {

// A thread for each of `count` things.
template <class Job, class Kernel>
int run(const Job& job, Kernel kernel, std::int64_t count) {
  return on_device(job.device, [&] {
    launch(kernel, blocks_for(count, kGrowthThreads), kGrowthThreads, static_cast<cudaStream_t>(job.stream), job);
    return cudaSuccess;
  });
}

}  // namespace

GGSLAM_EXPORT int ggslam_cuda_fill_words(const FillJob* job) {
  std::int64_t most = 0;
  for (int k = 0; k < job->count; ++k) most = std::max(most, job->fills[k].count);
  return run(*job, fill_words_kernel, most);
}

GGSLAM_EXPORT int ggslam_cuda_vote_labels(const VoteLabelJob* job) {
  return run(*job, vote_labels_kernel, job->count);
}

GGSLAM_EXPORT int ggslam_cuda_birth_labels(const BirthLabelJob* job) {
  return run(*job, birth_labels_kernel, job->count);
}

GGSLAM_EXPORT int ggslam_cuda_new_classes(const NewClassJob* job) {
  return run(*job, new_classes_kernel, static_cast<std::int64_t>(job->count) * (job->channels + 1));
}
