// SPDX-License-Identifier: Apache-2.0
// The C interface of the image loss. Only starts work on the caller's stream. Functions return 0 or a cudaError_t.
#include "common/host.cuh"
#include "mapping/image_loss_kernels.cuh"

using namespace ggslam::cuda;

GGSLAM_EXPORT std::int64_t ggslam_cuda_image_loss_bytes(const ImageLossJob* job) {
  return static_cast<std::int64_t>(loss_workspace(nullptr, *job).bytes);
}

GGSLAM_EXPORT int ggslam_cuda_image_loss(const ImageLossJob* job) {
  return on_device(job->device, [&] {
    const LossWorkspace w = loss_workspace(job->workspace, *job);
    const LossTiles tiles = loss_tiles(*job);
    const cudaStream_t stream = static_cast<cudaStream_t>(job->stream);
    const std::int64_t pixels = static_cast<std::int64_t>(job->height) * job->width, blocks = tiles.count();
    const cudaError_t cleared = cudaMemsetAsync(w.valid_pixels, 0, sizeof(std::uint32_t), stream);
    launch(count_depth_kernel, blocks_for(pixels, kLossThreads), kLossThreads, stream, *job, w);
    if (job->dssim_weight > 0) {
      launch(similarity_kernel, 3 * blocks, kLossThreads, stream, *job, tiles, w);
      launch(color_kernel<true>, 3 * blocks, kLossThreads, stream, *job, tiles, w);
    } else {
      launch(color_kernel<false>, 3 * blocks, kLossThreads, stream, *job, tiles, w);
    }
    launch(depth_kernel, blocks, kLossThreads, stream, *job, tiles, w);
    launch(collect_kernel, 1, kCollectThreads, stream, *job, tiles, w);
    return cleared;
  });
}
