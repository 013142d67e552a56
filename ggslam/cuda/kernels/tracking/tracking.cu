// SPDX-License-Identifier: Apache-2.0
// The C interface of tracking: points of a depth image, the voxels of a target, grey values, alignment; and all of it in
// one call. Work is started on the caller's stream. Functions return 0 or a cudaError_t.
#include "common/host.cuh"
#include "sight/mover_evidence_launch.cuh"
#include "tracking/alignment_kernels.cuh"
#include "tracking/depth_points.cuh"
#include "tracking/grey_images.cuh"
#include "tracking/residual_medians.cuh"
#include "tracking/voxel_shapes.cuh"

using namespace ggslam::cuda;
using ggslam::AlignSettings;

namespace {

void launch_points(const DepthPointsJob& job, cudaStream_t stream) {
  const std::int64_t blocks = blocks_for(static_cast<std::int64_t>(job.columns) * job.rows, kPointThreads);
  launch(find_points_kernel, blocks, kPointThreads, stream, job);
  launch(write_points_kernel, blocks, kPointThreads, stream, job);
  launch(median_depth_kernel, 1, kMedianThreads, stream, job);
}

cudaError_t launch_level(const VoxelLevelJob& job, cudaStream_t stream) {
  cudaError_t emptied = cudaSuccess;
  if (job.empties || job.old_slots != nullptr) {
    const std::size_t bytes = static_cast<std::size_t>(job.level.slot_mask + 1) * sizeof(VoxelSlot);
    emptied = cudaMemsetAsync(job.level.slots, 0xff, bytes, stream);
  }
  if (job.old_slots != nullptr)
    launch(move_table_kernel, blocks_for(static_cast<std::int64_t>(job.old_mask) + 1, kTableThreads), kTableThreads, stream,
           job);
  const int changed = job.block_count > job.voxel_count ? job.block_count : job.voxel_count;
  launch(change_level_kernel, blocks_for(changed, kTableThreads), kTableThreads, stream, job);
  if (job.new_moments != nullptr)
    launch(finish_voxels_kernel, blocks_for(job.voxel_count, kFinishThreads), kFinishThreads, stream, job);
  return emptied;
}

void launch_alignment(const AlignJob& job, cudaStream_t stream) {
  const AlignBlocks coarse = align_blocks(job, true), fine = align_blocks(job, false);
  const AlignWorkspace work = align_workspace(job.workspace, fine.points + fine.grey, job.room);
  const AlignSettings& s = job.settings;
  const int fine_points = static_cast<int>(fine.points), coarse_points = static_cast<int>(coarse.points);
  for (int i = 0; i < s.coarse_iterations; ++i)
    launch(descend_kernel<false>, coarse.points, kAlignThreads, stream, job, work, kCoarsePhase, coarse_points, i == 0);
  for (int i = 0; i < s.fine_iterations || i == 0; ++i)
    launch(fine.grey > 0 ? descend_kernel<true> : descend_kernel<false>, fine.points + fine.grey, kAlignThreads, stream,
           job, work, kFinePhase, fine_points, i == 0 && s.coarse_iterations <= 0);
  launch(fine.grey > 0 ? report_kernel<true> : report_kernel<false>, fine.points + fine.grey, kAlignThreads, stream,
         job, work, fine_points);
}

}  // namespace

GGSLAM_EXPORT std::int64_t ggslam_cuda_depth_points_bytes(const DepthPointsJob* job) {
  const std::int64_t cells = static_cast<std::int64_t>(job->columns) * job->rows;
  return blocks_for(cells + 1, kPointThreads) * (kPointThreads / kWarp) * static_cast<std::int64_t>(sizeof(std::uint32_t));
}

GGSLAM_EXPORT int ggslam_cuda_depth_points(const DepthPointsJob* job) {
  return on_device(job->device, [&] {
    launch_points(*job, static_cast<cudaStream_t>(job->stream));
    return cudaSuccess;
  });
}

GGSLAM_EXPORT int ggslam_cuda_voxel_level(const VoxelLevelJob* job) {
  return on_device(job->device, [&] { return launch_level(*job, static_cast<cudaStream_t>(job->stream)); });
}

GGSLAM_EXPORT std::int64_t ggslam_cuda_align_bytes(const AlignJob* job) {
  const AlignBlocks blocks = align_blocks(*job, false);
  return static_cast<std::int64_t>(align_workspace(nullptr, blocks.points + blocks.grey, job->room).bytes);
}

GGSLAM_EXPORT int ggslam_cuda_align_results() { return kAlignResults; }

GGSLAM_EXPORT int ggslam_cuda_align(const AlignJob* job) {
  return on_device(job->device, [&] {
    launch_alignment(*job, static_cast<cudaStream_t>(job->stream));
    return cudaSuccess;
  });
}

GGSLAM_EXPORT std::int64_t ggslam_cuda_grey_bytes(const GreyJob* job) {
  return static_cast<std::int64_t>(grey_workspace(*job).bytes);
}

GGSLAM_EXPORT int ggslam_cuda_track_wait(const TrackJob* job) {
  return on_device(job->align.device, [&] {
    const cudaStream_t stream = static_cast<cudaStream_t>(job->align.stream);
    if (job->makes_points) launch_points(job->points, stream);
    if (job->makes_levels) {
      const cudaError_t fine = launch_level(job->fine, stream), coarse = launch_level(job->coarse, stream);
      if (fine != cudaSuccess || coarse != cudaSuccess) return fine != cudaSuccess ? fine : coarse;
    }
    if (job->makes_reference) launch_greys(job->reference, stream);
    if (job->makes_greys) launch_greys(job->greys, stream);
    launch_alignment(job->align, stream);
    if (job->looks) launch(residual_medians_kernel, 2, kMedianThreads, stream, job->align);
    if (job->makes_evidence) {
      const cudaError_t found = launch_mover_evidence(job->evidence, stream);
      if (found != cudaSuccess) return found;
    }
    const cudaError_t copied = cudaMemcpyAsync(job->results, job->align.results, kAlignResults * sizeof(double),
                                               cudaMemcpyDeviceToHost, stream);
    return copied != cudaSuccess ? copied : cudaStreamSynchronize(stream);
  });
}
