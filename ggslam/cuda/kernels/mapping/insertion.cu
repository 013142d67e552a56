// SPDX-License-Identifier: Apache-2.0
// The C interface of inserting Gaussians. Only starts work on the caller's stream. Functions return 0 or a cudaError_t.
#include "common/host.cuh"
#include "mapping/insertion_filling.cuh"
#include "mapping/insertion_selection.cuh"
#include "mapping/insertion_shapes.cuh"

using namespace ggslam::cuda;
using namespace ggslam::cuda::insertion;

GGSLAM_EXPORT std::int64_t ggslam_cuda_insertion_bytes(const InsertionJob* job) {
  return static_cast<std::int64_t>(workspace_of(nullptr, *job).bytes);
}

GGSLAM_EXPORT int ggslam_cuda_insertion_select(const InsertionJob* job) {
  return on_device(job->device, [&] {
    const Workspace w = workspace_of(job->workspace, *job);
    const Candidates candidates = candidates_of(*job);
    const cudaStream_t stream = static_cast<cudaStream_t>(job->stream);
    const std::int64_t fills = candidates.count - candidates.pixels;
    const std::int64_t wide = blocks_for(job->width, kTileWide), high = blocks_for(job->height, kTileHigh);
    launch(choose_kernel, wide * high, kThreads, stream, *job, static_cast<int>(wide), w);
    if (fills > 0) {
      launch(known_row_kernel, blocks_for(job->width, kColumns), kColumnThreads, stream, *job, w);
      launch(choose_filling_kernel, blocks_for(fills, kFillThreads), kFillThreads, stream, *job, candidates, w);
    }
    const cudaError_t summed = running_sum(w.scratch, w.scratch_bytes, w.chosen, w.sums, candidates.count, stream);
    launch(collect_kernel, blocks_for(candidates.count, kThreads), kThreads, stream, *job, candidates, w);
    return summed;
  });
}

GGSLAM_EXPORT int ggslam_cuda_insertion_build(const InsertionJob* job) {
  return on_device(job->device, [&] {
    const cudaStream_t stream = static_cast<cudaStream_t>(job->stream);
    launch(build_kernel, blocks_for(job->count, kBuildThreads), kBuildThreads, stream, *job, candidates_of(*job),
           workspace_of(job->workspace, *job));
    return cudaSuccess;
  });
}
