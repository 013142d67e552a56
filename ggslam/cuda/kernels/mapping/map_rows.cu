// SPDX-License-Identifier: Apache-2.0
// The C interface of rows of a map that go. Only starts work on the caller's stream. Functions return 0 or a cudaError_t;
// the caller has checked sizes and pointers.
#include "mapping/map_rows.cuh"

#include <algorithm>

#include "common/host.cuh"

using namespace ggslam::cuda;

GGSLAM_EXPORT int ggslam_cuda_prune(const PruneJob* job) {
  return on_device(job->device, [&] {
    launch(prune_kernel, blocks_for(job->count, kRowThreads), kRowThreads, static_cast<cudaStream_t>(job->stream), *job);
    return cudaSuccess;
  });
}

GGSLAM_EXPORT std::int64_t ggslam_cuda_rows_bytes(const RowsJob* job) {
  return static_cast<std::int64_t>(rows_workspace(nullptr, *job).bytes);
}

GGSLAM_EXPORT int ggslam_cuda_choose_rows(const RowsJob* job) {
  return on_device(job->device, [&] {
    const RowsWorkspace w = rows_workspace(job->workspace, *job);
    const cudaStream_t stream = static_cast<cudaStream_t>(job->stream);
    const std::int64_t blocks = blocks_for(job->count, kRowThreads);
    launch(mark_rows_kernel, blocks, kRowThreads, stream, *job, w);
    const cudaError_t summed = running_sum(w.scratch, w.scratch_bytes, w.chosen, w.sums, job->count, stream);
    launch(number_rows_kernel, blocks, kRowThreads, stream, *job, w);
    return summed;
  });
}

GGSLAM_EXPORT int ggslam_cuda_move_rows(const RowsJob* job, std::int64_t kept) {
  return on_device(job->device, [&] {
    const RowsWorkspace w = rows_workspace(job->workspace, *job);
    const cudaStream_t stream = static_cast<cudaStream_t>(job->stream);
    std::int64_t most = 1;
    for (int k = 0; k < job->array_count; ++k) most = std::max(most, job->arrays[k].words);
    for (std::int64_t begin = 0; begin < kept; begin += kRowsAtOnce) {
      const std::int64_t count = std::min(kRowsAtOnce, kept - begin);
      const std::int64_t blocks = std::min(kRowBlocks, blocks_for(count * most, kRowThreads));
      launch(gather_rows_kernel, blocks, kRowThreads, stream, *job, w, begin, count);
      launch(put_rows_kernel, blocks, kRowThreads, stream, *job, w, begin, count);
    }
    return cudaSuccess;
  });
}
