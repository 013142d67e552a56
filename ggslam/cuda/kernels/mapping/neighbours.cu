// SPDX-License-Identifier: Apache-2.0
// The C interface of the search for nearest points. Only starts work on the caller's stream. Functions return 0 or a
// cudaError_t.
#include "mapping/neighbours.cuh"

#include "common/host.cuh"

using namespace ggslam::cuda;
using namespace ggslam::cuda::neighbours;

GGSLAM_EXPORT std::int64_t ggslam_cuda_neighbours_bytes(const NeighbourJob* job) {
  return static_cast<std::int64_t>(workspace_of(nullptr, *job).bytes);
}

GGSLAM_EXPORT int ggslam_cuda_neighbours(const NeighbourJob* job) {
  return on_device(job->device, [&] {
    const Workspace w = workspace_of(job->workspace, *job);
    const Parts parts = parts_of(*job);
    const cudaStream_t stream = static_cast<cudaStream_t>(job->stream);
    const std::int64_t row_blocks = blocks_for(job->row_count, kRowsPerBlock);
    launch(search_kernel, row_blocks * parts.count, kThreads, stream, *job, parts, w);
    launch(merge_kernel, row_blocks, kThreads, stream, *job, parts, w);
    return cudaSuccess;
  });
}
