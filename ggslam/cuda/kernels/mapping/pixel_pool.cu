// SPDX-License-Identifier: Apache-2.0
// The C interface of drawing pixels for identity learning. Only starts work on the caller's stream. Functions return 0
// or a cudaError_t.
#include "mapping/pixel_pool.cuh"

#include "common/host.cuh"

using namespace ggslam::cuda;

GGSLAM_EXPORT int ggslam_cuda_pixel_odds(const PixelPoolJob* job) {
  return on_device(job->device, [&] {
    const cudaStream_t stream = static_cast<cudaStream_t>(job->stream);
    const std::int64_t blocks = blocks_for(static_cast<std::int64_t>(job->height) * job->width, kPoolThreads);
    const cudaError_t cleared = cudaMemsetAsync(job->counts, 0, 2 * kObjectIds * sizeof(std::int32_t), stream);
    launch(count_objects_kernel, blocks, kPoolThreads, stream, *job);
    launch(object_odds_kernel, 1, kTotalThreads, stream, *job);
    launch(pixel_odds_kernel, blocks, kPoolThreads, stream, *job);
    return cleared;
  });
}

GGSLAM_EXPORT int ggslam_cuda_draw_pixels(const PixelPoolJob* job) {
  return on_device(job->device, [&] {
    launch(draw_pixels_kernel, blocks_for(job->drawn, kPoolThreads), kPoolThreads,
           static_cast<cudaStream_t>(job->stream), *job);
    return cudaSuccess;
  });
}
