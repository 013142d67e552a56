// SPDX-License-Identifier: Apache-2.0
// The C interface of the distance field.
#include "common/host.cuh"
#include "volumes/field_sites.cuh"
#include "volumes/field_update.cuh"

using namespace ggslam::cuda;

GGSLAM_EXPORT int ggslam_cuda_field_update(const FieldJob* job) {
  return on_device(job->device, [&] {
    const cudaStream_t stream = static_cast<cudaStream_t>(job->stream);
    // By which nodes are wider than what they hold, for roundings.
    const float slack = 0.01f + 3e-7f * job->max_distance * job->max_distance;
    const std::int64_t grid = job->grid;
    launch(begin_update_kernel, 1, 2 * kWarp, stream, *job);
    launch(mark_rows_kernel, grid, kListThreads, stream, *job);
    launch(list_rows_kernel, grid, kListThreads, stream, *job, kFindCrossings, static_cast<int>(kListedRows));
    launch(crossings_kernel, grid, kVoxels, stream, *job);
    launch(list_rows_kernel, grid, kListThreads, stream, *job, kFindCrossings | kFindSites, static_cast<int>(kSiteRows));
    launch(sites_kernel, grid, kVoxels, stream, *job, slack);
    launch(settle_sites_kernel, 1, kWarp, stream, *job);
    launch(list_touched_kernel, grid, kListThreads, stream, *job);
    launch(select_kernel, grid, kSelectThreads, stream, *job);
    launch(distances_kernel, grid, kVoxels, stream, *job, slack);
    launch(finish_update_kernel, grid, kListThreads, stream, *job);
    return cudaSuccess;
  });
}
