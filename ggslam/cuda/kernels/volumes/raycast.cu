// SPDX-License-Identifier: Apache-2.0
// The C interface of casting rays.
#include "common/host.cuh"
#include "volumes/cast_rays.cuh"

using namespace ggslam::cuda;

GGSLAM_EXPORT int ggslam_cuda_cast_rays(const CastJob* job) {
  return on_device(job->device, [&] {
    const cudaStream_t stream = static_cast<cudaStream_t>(job->stream);
    const int wide = static_cast<int>(blocks_for(job->width, kRayTile));
    launch(find_inside_kernel, job->grid, kVoxels, stream, *job);
    launch(find_cells_kernel, job->grid, kVoxels, stream, *job);
    launch(cast_kernel, wide * blocks_for(job->height, kRayTile), kRayThreads, stream, *job, wide);
    return cudaSuccess;
  });
}
