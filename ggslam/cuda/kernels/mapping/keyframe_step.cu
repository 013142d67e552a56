// SPDX-License-Identifier: Apache-2.0
// The C interface of the keyframes' states. Only starts work on the caller's stream. Functions return 0 or a
// cudaError_t.
#include "common/host.cuh"
#include "mapping/keyframe_step.cuh"

using namespace ggslam::cuda;

// Sizes of the structs, so that a caller can check that its mirrors of them are the same.
GGSLAM_EXPORT int ggslam_cuda_keyframe_state_size() { return static_cast<int>(sizeof(KeyframeState)); }
GGSLAM_EXPORT int ggslam_cuda_keyframe_step_job_size() { return static_cast<int>(sizeof(KeyframeStepJob)); }
GGSLAM_EXPORT int ggslam_cuda_keyframe_write_job_size() { return static_cast<int>(sizeof(KeyframeWriteJob)); }

// One step of a keyframe's pose and exposure, and the sums of the loss.
GGSLAM_EXPORT int ggslam_cuda_keyframe_step(const KeyframeStepJob* job) {
  return on_device(job->device, [&] {
    launch(keyframe_step_kernel, 1, kWarp, static_cast<cudaStream_t>(job->stream), *job);
    return cudaSuccess;
  });
}

// Sets a keyframe's pose, or all of its state. The numbers travel as arguments of the kernel: no memory of the host is
// read later.
GGSLAM_EXPORT int ggslam_cuda_keyframe_write(const KeyframeWriteJob* job) {
  return on_device(job->device, [&] {
    launch(keyframe_write_kernel, 1, kWarp, static_cast<cudaStream_t>(job->stream), *job);
    return cudaSuccess;
  });
}
