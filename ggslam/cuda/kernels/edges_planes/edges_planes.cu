// SPDX-License-Identifier: Apache-2.0
// The C interface of tracking by edges and planes: features of a depth image, the local map, alignment; and all of it
// in one call. Work is started on the caller's stream. Functions return 0 or a cudaError_t.
#include "common/host.cuh"
#include "edges_planes/feature_adding.cuh"
#include "edges_planes/feature_alignment.cuh"
#include "edges_planes/scan_segments.cuh"
#include "sight/mover_evidence_launch.cuh"

using namespace ggslam::cuda;

namespace {

std::int64_t segment_bytes(const FeatureScanJob& job) {
  if (job.small.filtered == nullptr) return 0;
  return static_cast<std::int64_t>(segment_workspace(nullptr, job.small).bytes);
}

void launch_medians(const FeatureScanJob& job, cudaStream_t stream) {
  launch(feature_medians_kernel, 3, kMedianThreads, stream, job);
}

void launch_scan(const FeatureScanJob& job, cudaStream_t stream) {
  const FeatureSettings& s = job.settings;
  if (job.small.filtered != nullptr) launch_scan_segments(job, job.workspace, stream);
  const ScanWorkspace work = scan_workspace(static_cast<char*>(job.workspace) + segment_bytes(job), s);
  const std::int64_t places = static_cast<std::int64_t>(s.lines) * inner_places(s);
  const std::int64_t groups = blocks_for(static_cast<std::int64_t>(all_groups(s)) * kWarp, kPickThreads);
  launch(score_kernel, blocks_for(places, kScoreThreads), kScoreThreads, stream, job, work.edge_scores,
         work.plane_scores);
  launch(pick_kernel, groups, kPickThreads, stream, job, work);
  launch(write_features_kernel, groups > 0 ? groups : 1, kPickThreads, stream, job, work);
  launch_medians(job, stream);
}

cudaError_t launch_update(const FeatureTrackJob& job, cudaStream_t stream) {
  const FeatureTable& table = job.add.table;
  if (job.clears) {
    const std::size_t bytes = static_cast<std::size_t>(table.slots) * sizeof(std::int64_t);
    const cudaError_t cleared = cudaMemsetAsync(table.keys, 0xff, bytes, stream);
    if (cleared != cudaSuccess) return cleared;
  }
  return job.adds ? launch_add(job.add, stream) : cudaSuccess;
}

}  // namespace

GGSLAM_EXPORT std::int64_t ggslam_cuda_feature_room(const FeatureScanJob* job, std::int32_t edges) {
  const FeatureSettings& s = job->settings;
  const int most = edges ? s.edges_per_segment : s.planes_per_segment, lines = edges ? s.lines : s.rows;
  if (most == 0) return 0;
  return static_cast<std::int64_t>(lines) * s.segments * (picks_all(s, most) ? s.segment : most);
}

GGSLAM_EXPORT std::int64_t ggslam_cuda_feature_scan_bytes(const FeatureScanJob* job) {
  return segment_bytes(*job) + static_cast<std::int64_t>(scan_workspace(nullptr, job->settings).bytes);
}

GGSLAM_EXPORT int ggslam_cuda_feature_scan(const FeatureScanJob* job) {
  return on_device(job->device, [&] {
    launch_scan(*job, static_cast<cudaStream_t>(job->stream));
    return cudaSuccess;
  });
}

GGSLAM_EXPORT int ggslam_cuda_feature_medians(const FeatureScanJob* job) {
  return on_device(job->device, [&] {
    launch_medians(*job, static_cast<cudaStream_t>(job->stream));
    return cudaSuccess;
  });
}

GGSLAM_EXPORT std::int64_t ggslam_cuda_feature_add_bytes(const FeatureAddJob* job) {
  return static_cast<std::int64_t>(add_workspace(nullptr, job->room).bytes);
}

GGSLAM_EXPORT int ggslam_cuda_feature_update(const FeatureTrackJob* job) {
  return on_device(job->add.device, [&] { return launch_update(*job, static_cast<cudaStream_t>(job->add.stream)); });
}

GGSLAM_EXPORT int ggslam_cuda_feature_track_wait(const FeatureTrackJob* job) {
  return on_device(job->align.device, [&] {
    const cudaStream_t stream = static_cast<cudaStream_t>(job->align.stream);
    const cudaError_t updated = launch_update(*job, stream);
    if (updated != cudaSuccess) return updated;
    if (job->scans) launch_scan(job->scan, stream);
    launch(align_features_kernel, 1, kFeatureThreads, stream, job->align);
    if (job->makes_evidence) {
      const cudaError_t found = launch_mover_evidence(job->evidence, stream);
      if (found != cudaSuccess) return found;
    }
    const cudaError_t copied = cudaMemcpyAsync(job->results, job->align.results, kFeatureResults * sizeof(double),
                                               cudaMemcpyDeviceToHost, stream);
    return copied != cudaSuccess ? copied : cudaStreamSynchronize(stream);
  });
}
