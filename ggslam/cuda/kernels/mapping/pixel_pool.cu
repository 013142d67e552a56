// SPDX-License-Identifier: Apache-2.0
// The C interface of drawing pixels for identity learning. Only starts work on the caller's stream. Functions return 0
// or a cudaError_t.
#include "mapping/pixel_pool.cuh"

#include "common/host.cuh"

using namespace ggslam::cuda;

GGSLAM_EXPORT std::int64_t ggslam_cuda_pixel_pool_bytes(const PixelPoolJob* job) {
  return static_cast<std::int64_t>(pool_workspace(nullptr, *job).bytes);
}

GGSLAM_EXPORT int ggslam_cuda_draw_pixels(const PixelPoolJob* job) {
  return on_device(job->device, [&] {
    const PoolWorkspace w = pool_workspace(job->workspace, *job);
    const cudaStream_t stream = static_cast<cudaStream_t>(job->stream);
    const std::int64_t pixels = static_cast<std::int64_t>(job->height) * job->width;
    const std::int64_t blocks = blocks_for(pixels, kPoolThreads);
    const cudaError_t cleared = cudaMemsetAsync(w.counts, 0, 2 * kObjectIds * sizeof(std::int32_t), stream);
    launch(count_objects_kernel, blocks, kPoolThreads, stream, *job, w);
    launch(object_odds_kernel, 1, kTotalThreads, stream, *job, w);
    launch(pixel_odds_kernel, blocks, kPoolThreads, stream, *job, w);
    const cudaError_t summed = long_running_sum(w.scratch, w.scratch_bytes, w.odds, w.sums, pixels, stream);
    launch(draw_pixels_kernel, blocks_for(job->drawn, kPoolThreads), kPoolThreads, stream, *job, w);
    launch(even_out_weights_kernel, 1, kTotalThreads, stream, *job);
    return cleared != cudaSuccess ? cleared : summed;
  });
}
