// SPDX-License-Identifier: Apache-2.0
// The C interface of identity learning's losses. Only starts work on the caller's stream. Functions return 0 or a
// cudaError_t; the caller has checked sizes and pointers.
#include "mapping/class_learning.cuh"

#include "common/host.cuh"

using namespace ggslam::cuda;

namespace {

template <class Job, class Kernel>
int run(const Job& job, Kernel kernel, std::int64_t blocks) {
  return on_device(job.device, [&] {
    launch(kernel, blocks, kClassThreads, static_cast<cudaStream_t>(job.stream), job);
    return cudaSuccess;
  });
}

}  // namespace

GGSLAM_EXPORT int ggslam_cuda_pixel_labels(const PixelClassJob* job) {
  return run(*job, pixel_labels_kernel, blocks_for(job->count, kClassThreads));
}

GGSLAM_EXPORT int ggslam_cuda_pixel_classes(const PixelClassJob* job) {
  return on_device(job->device, [&] {
    const cudaStream_t stream = static_cast<cudaStream_t>(job->stream);
    const cudaError_t cleared = cudaMemsetAsync(job->known, 0, sizeof(std::int32_t), stream);
    launch(pixel_classes_kernel, blocks_for(job->count, kClassThreads), kClassThreads, stream, *job);
    return cleared;
  });
}

GGSLAM_EXPORT int ggslam_cuda_cross_entropy(const CrossEntropyJob* job) {
  return run(*job, cross_entropy_kernel, blocks_for(job->count, kClassWarps));
}

GGSLAM_EXPORT int ggslam_cuda_neighbour_loss(const NeighbourLossJob* job) {
  return run(*job, neighbour_loss_kernel, blocks_for(job->samples, kClassWarps));
}

GGSLAM_EXPORT int ggslam_cuda_class_adam(const ClassAdamJob* job) {
  return on_device(job->device, [&] {
    const cudaStream_t stream = static_cast<cudaStream_t>(job->stream);
    launch(class_adam_kernel, blocks_for(job->size, kClassThreads), kClassThreads, stream, *job);
    launch(count_step_kernel, 1, kWarp, stream, *job);
    return cudaSuccess;
  });
}
