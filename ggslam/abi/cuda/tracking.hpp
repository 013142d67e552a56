// SPDX-License-Identifier: Apache-2.0
// The CUDA kernels' tracking. Pointers lead to device memory. Calls only start work on the caller's stream; those with a
// status return 0 or a cudaError_t.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/core/tracking.hpp"
#include "abi/export.hpp"

namespace ggslam::cuda {

// What the device alone knows of a frame's points.
struct PointsHeader {
  std::int32_t count;
  float median_depth;  // metres, 0 without points
};

// The points of a frame, row by row of the image; `count` of the header are in use.
struct PointArrays {
  PointsHeader* header;
  float* points;         // [n, 3] camera frame, metres
  float* normals;        // [n, 3] unit, towards the camera
  float* covariances;    // [n, 6] xx xy xz yy yz zz, median eigenvalue 1
  std::int32_t* pixels;  // [n, 2] u, v
  float* weights;        // [n] (sigma(1 m) / sigma(z))^2
};

// Points to take from a depth image.
struct DepthPointsJob {
  const float* depth;  // [height, width]
  PointArrays out;     // room for columns * rows points
  void* workspace;     // room for a bit for each grid point, in whole words of 32
  void* stream;
  DepthPointsSettings settings;
  std::int32_t device, columns, rows;  // of the grid
};

// A block of 4 x 4 x 4 voxels, which lie one after the other in the order of their bits x + 4 y + 16 z.
struct VoxelBlock {
  std::uint64_t key, occupied, first;
};

// A place of the hash table with open addressing: all that a look-up reads lies in one sector of memory.
struct alignas(32) VoxelSlot {
  std::uint64_t key;  // kEmptyKey: free
  std::uint64_t occupied;
  std::uint64_t first;
  std::uint64_t reserved;
};

// The voxels of one size, and how they are found.
struct VoxelLevel {
  const Voxel* voxels;
  VoxelSlot* slots;
  std::uint64_t slot_mask;  // number of slots, a power of two, minus one
  float size, inverse_size;  // of a voxel, metres
};

// A level to set up.
struct VoxelLevelJob {
  const VoxelBlock* blocks;
  const VoxelMoments* moments;  // null: the voxels are finished
  VoxelLevel level;
  Voxel* voxels;  // those of the level, to be finished
  void* stream;
  TargetSettings settings;
  std::int32_t device, block_count, voxel_count;
};

// Points to align to a target.
struct AlignJob {
  PointArrays points;
  VoxelLevel fine, coarse;
  PhotometricPoints photometric_points;  // count 0: no photometric part
  PhotometricReferenceView reference;
  std::int32_t* match;      // [room] fine voxel of each point, or -1
  float* squared_distance;  // [room] squared point-to-plane distances, or infinity
  double* results;          // [kAlignResults], in the order of AlignResult
  void* workspace;          // see align_workspace
  void* stream;
  double guess[12];  // T_world_camera: rotation row by row, then translation
  AlignSettings settings;
  std::int32_t device;
  std::int32_t room;  // points at most
};

// Places of the results. Information (upper triangle row by row) is of a twist about the camera centre, world axes.
enum AlignResult {
  kPose,                               // as AlignJob::guess
  kInformation = kPose + 12,           // [21]
  kCost = kInformation + 21,           // per unit of weight
  kOverlap, kRmse,                     // share of all points; metres
  kPhotometricResidual, kPhotometricShare,
  kCoarseIterations, kFineIterations, kConverged, kUsable,
  kPointCount, kMedianDepth,           // of the points' header
  kSpreadTotal, kCentroid,             // sum of 1 / sigma(z)^2; mean point with these weights, camera frame
  kRadius = kCentroid + 3,             // root mean square distance from it
  kAlignResults
};

}  // namespace ggslam::cuda

// Bytes of memory that depth_points works in. Asks for columns and rows.
GGSLAM_EXPORT std::int64_t ggslam_cuda_depth_points_bytes(const ggslam::cuda::DepthPointsJob* job);

// Points of a depth image, their number and their median depth.
GGSLAM_EXPORT int ggslam_cuda_depth_points(const ggslam::cuda::DepthPointsJob* job);

// Empties the hash table of a level, which has more places than there are blocks, and puts the level's blocks in; gives
// the voxels their shapes if they have none yet.
GGSLAM_EXPORT int ggslam_cuda_voxel_level(const ggslam::cuda::VoxelLevelJob* job);

// Bytes of memory that an alignment works in; the caller sets them to zero before the first one. Asks for room,
// settings and the number of textured points.
GGSLAM_EXPORT std::int64_t ggslam_cuda_align_bytes(const ggslam::cuda::AlignJob* job);

// Aligns points to a target from a guess.
GGSLAM_EXPORT int ggslam_cuda_align(const ggslam::cuda::AlignJob* job);
