// SPDX-License-Identifier: Apache-2.0
// Starts the kernels of what moves; their C interface, for frames whose alignment did not bring the evidence along.
#include "sight/mover_evidence.cuh"
#include "sight/mover_evidence_launch.cuh"

namespace ggslam::cuda {

cudaError_t launch_mover_evidence(const MoverEvidenceJob& job, cudaStream_t stream) {
  const EvidenceWorkspace work = evidence_workspace(job);
  const std::int64_t blocks = blocks_for(places_of(job), kPlaceThreads);
  launch(coarse_places_kernel, blocks, kPlaceThreads, stream, job, work);
  launch(coarse_bounds_kernel, blocks, kPlaceThreads, stream, job, work);
  launch(telling_places_kernel, blocks * job.count, kPlaceThreads, stream, job, work);
  launch(noise_share_kernel, job.count, kMedianThreads, stream, job, work);
  launch(judge_places_kernel, blocks, kPlaceThreads, stream, job, work);
  return cudaMemcpyAsync(job.arrived, job.found, sizeof(MoverEvidenceFound), cudaMemcpyDeviceToHost, stream);
}

}  // namespace ggslam::cuda

using namespace ggslam::cuda;

GGSLAM_EXPORT std::int64_t ggslam_cuda_mover_evidence_bytes(const MoverEvidenceJob* job) {
  return static_cast<std::int64_t>(evidence_workspace(*job).bytes);
}

GGSLAM_EXPORT int ggslam_cuda_mover_evidence_wait(const MoverEvidenceJob* job) {
  return on_device(job->device, [&] {
    const cudaStream_t stream = static_cast<cudaStream_t>(job->stream);
    const cudaError_t copied = launch_mover_evidence(*job, stream);
    return copied != cudaSuccess ? copied : cudaStreamSynchronize(stream);
  });
}
