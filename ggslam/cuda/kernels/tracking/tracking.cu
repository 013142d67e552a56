// SPDX-License-Identifier: Apache-2.0
// The C interface of tracking: points of a depth image, the voxels of a target, alignment. Only starts work
// on the caller's stream. Functions return 0 or a cudaError_t.
#include "common/host.cuh"
#include "tracking/alignment_kernels.cuh"
#include "tracking/depth_points.cuh"
#include "tracking/voxel_shapes.cuh"

using namespace ggslam::cuda;
using ggslam::AlignSettings;

GGSLAM_EXPORT std::int64_t ggslam_cuda_depth_points_bytes(const DepthPointsJob* job) {
  const std::int64_t cells = static_cast<std::int64_t>(job->columns) * job->rows;
  return blocks_for(cells + 1, kPointThreads) * (kPointThreads / kWarp) * static_cast<std::int64_t>(sizeof(std::uint32_t));
}

GGSLAM_EXPORT int ggslam_cuda_depth_points(const DepthPointsJob* job) {
  return on_device(job->device, [&] {
    const cudaStream_t stream = static_cast<cudaStream_t>(job->stream);
    const std::int64_t blocks = blocks_for(static_cast<std::int64_t>(job->columns) * job->rows, kPointThreads);
    launch(find_points_kernel, blocks, kPointThreads, stream, *job);
    launch(write_points_kernel, blocks, kPointThreads, stream, *job);
    launch(median_depth_kernel, 1, kMedianThreads, stream, *job);
    return cudaSuccess;
  });
}

GGSLAM_EXPORT int ggslam_cuda_voxel_level(const VoxelLevelJob* job) {
  return on_device(job->device, [&] {
    const cudaStream_t stream = static_cast<cudaStream_t>(job->stream);
    const std::size_t bytes = static_cast<std::size_t>(job->level.slot_mask + 1) * sizeof(VoxelSlot);
    const cudaError_t cleared = cudaMemsetAsync(job->level.slots, 0xff, bytes, stream);
    launch(fill_table_kernel, blocks_for(job->block_count, kTableThreads), kTableThreads, stream, *job);
    if (job->moments != nullptr)
      launch(finish_voxels_kernel, blocks_for(job->voxel_count, kFinishThreads), kFinishThreads, stream, *job);
    return cleared;
  });
}

GGSLAM_EXPORT std::int64_t ggslam_cuda_align_bytes(const AlignJob* job) {
  const AlignBlocks blocks = align_blocks(*job, false);
  return static_cast<std::int64_t>(align_workspace(nullptr, blocks.points + blocks.grey, job->room).bytes);
}

GGSLAM_EXPORT int ggslam_cuda_align_results() { return kAlignResults; }

GGSLAM_EXPORT int ggslam_cuda_align(const AlignJob* job) {
  return on_device(job->device, [&] {
    const cudaStream_t stream = static_cast<cudaStream_t>(job->stream);
    const AlignBlocks coarse = align_blocks(*job, true), fine = align_blocks(*job, false);
    const AlignWorkspace work = align_workspace(job->workspace, fine.points + fine.grey, job->room);
    const AlignSettings& s = job->settings;
    const int fine_points = static_cast<int>(fine.points), coarse_points = static_cast<int>(coarse.points);
    for (int i = 0; i < s.coarse_iterations; ++i)
      launch(descend_kernel<false>, coarse.points, kAlignThreads, stream, *job, work, kCoarsePhase, coarse_points, i == 0);
    for (int i = 0; i < s.fine_iterations || i == 0; ++i)
      launch(fine.grey > 0 ? descend_kernel<true> : descend_kernel<false>, fine.points + fine.grey, kAlignThreads, stream,
             *job, work, kFinePhase, fine_points, i == 0 && s.coarse_iterations <= 0);
    launch(fine.grey > 0 ? report_kernel<true> : report_kernel<false>, fine.points + fine.grey, kAlignThreads, stream,
           *job, work, fine_points);
    return cudaSuccess;
  });
}
