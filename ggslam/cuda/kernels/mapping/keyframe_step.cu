// SPDX-License-Identifier: Apache-2.0
// The C interface of the keyframes' states. Only starts work on the caller's stream. Functions return 0 or a
// cudaError_t.
#include "common/host.cuh"
#include "mapping/keyframe_step.cuh"

using namespace ggslam::cuda;

GGSLAM_EXPORT int ggslam_cuda_keyframe_step(const KeyframeStepJob* job) {
  return on_device(job->device, [&] {
    launch(keyframe_step_kernel, 1, kWarp, static_cast<cudaStream_t>(job->stream), *job);
    return cudaSuccess;
  });
}

GGSLAM_EXPORT int ggslam_cuda_keyframe_write(const KeyframeWriteJob* job) {
  return on_device(job->device, [&] {
    launch(keyframe_write_kernel, 1, kWarp, static_cast<cudaStream_t>(job->stream), *job);
    return cudaSuccess;
  });
}
