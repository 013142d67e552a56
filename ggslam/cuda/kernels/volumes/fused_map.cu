// SPDX-License-Identifier: Apache-2.0
// The memory of a map on the device: emptied, and moved to larger memory.
#include "common/host.cuh"
#include "volumes/fused_map.cuh"

using namespace ggslam::cuda;

namespace {

constexpr int kMoveThreads = 256;

template <class T>
__device__ void copy(const T* from, T* to, std::int64_t count) {
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kMoveThreads;
  for (std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kMoveThreads + threadIdx.x; i < count; i += stride)
    to[i] = from[i];
}

__global__ void __launch_bounds__(kMoveThreads) clear_kernel(FusedMap map) {
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kMoveThreads;
  const std::int64_t first = static_cast<std::int64_t>(blockIdx.x) * kMoveThreads + threadIdx.x;
  for (std::int64_t i = first; i <= map.place_mask; i += stride) map.keys[i] = kNoKey;
  if (first < kFusedCounts) map.counts[first] = 0;
}

// Blocks are copied word by word; that a block is present does not matter.
__global__ void __launch_bounds__(kMoveThreads) move_kernel(FusedMap from, FusedMap to) {
  constexpr std::int64_t kBlockWords = sizeof(FusedBlock) / 4, kVoxelWords = sizeof(FusedVoxels) / 4;
  constexpr std::int64_t kPointWords = sizeof(FusedPoints) / 4;
  const std::int64_t rows = from.counts[kRowsUsed], slots = from.counts[kSlotsUsed];
  const auto words = [](auto* p) { return reinterpret_cast<std::uint32_t*>(p); };
  copy(words(from.blocks), words(to.blocks), kBlockWords * rows);
  copy(from.free_slots, to.free_slots, static_cast<std::int64_t>(from.counts[kFreeSlots]));
  if (from.voxels != to.voxels) copy(words(from.voxels), words(to.voxels), kVoxelWords * slots);
  if (from.points != nullptr && from.points != to.points) copy(words(from.points), words(to.points), kPointWords * slots);
}

// The places of keys in the table of another size.
__global__ void __launch_bounds__(kMoveThreads) place_kernel(FusedMap map) {
  const std::int32_t rows = map.counts[kRowsUsed], stride = static_cast<std::int32_t>(gridDim.x) * kMoveThreads;
  for (std::int32_t row = static_cast<std::int32_t>(blockIdx.x) * kMoveThreads + static_cast<std::int32_t>(threadIdx.x);
       row < rows; row += stride) {
    const std::int32_t* at = map.blocks[row].at;
    insert_row(map, key_of(at[0], at[1], at[2]), row);
  }
}

__global__ void __launch_bounds__(kMoveThreads) empty_kernel(FusedMap map) {
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kMoveThreads;
  for (std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kMoveThreads + threadIdx.x; i <= map.place_mask;
       i += stride)
    map.keys[i] = kNoKey;
}

std::int64_t blocks_of(std::int64_t count) { return count < 1024 * kMoveThreads ? blocks_for(count, kMoveThreads) : 1024; }

}  // namespace

GGSLAM_EXPORT int ggslam_cuda_fused_clear(const FusedMoveJob* job) {
  return on_device(job->device, [&] {
    launch(clear_kernel, blocks_of(static_cast<std::int64_t>(job->to.place_mask) + 1), kMoveThreads,
           static_cast<cudaStream_t>(job->stream), job->to);
    return cudaSuccess;
  });
}

GGSLAM_EXPORT int ggslam_cuda_fused_move(const FusedMoveJob* job) {
  return on_device(job->device, [&] {
    const cudaStream_t stream = static_cast<cudaStream_t>(job->stream);
    launch(move_kernel, blocks_of(static_cast<std::int64_t>(job->from.slot_room) * kVoxels), kMoveThreads, stream,
           job->from, job->to);
    launch(empty_kernel, blocks_of(static_cast<std::int64_t>(job->to.place_mask) + 1), kMoveThreads, stream, job->to);
    launch(place_kernel, blocks_of(job->from.row_room), kMoveThreads, stream, job->to);
    return cudaSuccess;
  });
}
