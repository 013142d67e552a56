// SPDX-License-Identifier: Apache-2.0
// The CUDA kernels' tracking. Pointers lead to device memory. Calls only start work on the caller's stream, but for
// ggslam_cuda_track_wait; those with a status return 0 or a cudaError_t.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/core/tracking.hpp"
#include "abi/cuda/sight.hpp"
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

// Blocks of a level that change, or come: all of them, where the table is emptied first. Their voxels go to indices that
// nothing else uses any more.
struct VoxelLevelJob {
  const VoxelBlock* blocks;         // [block_count]
  const std::int32_t* indices;      // [voxel_count] of their voxels, block by block
  const VoxelMoments* new_moments;  // [voxel_count] of their voxels, which get their shapes on the device; or null and
  const Voxel* new_voxels;          // [voxel_count] the voxels with their shapes
  const VoxelSlot* old_slots;       // the one before, no larger, whose blocks move to the level's; null: they are there
  std::uint64_t old_mask;           // of that, as slot_mask
  VoxelLevel level;
  VoxelMoments* moments;            // of the level's voxels
  Voxel* voxels;                    // those of the level
  void* stream;
  TargetSettings settings;
  std::int32_t device, block_count, voxel_count;
  std::int32_t empties;             // whether the table is emptied first
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
  const std::int32_t* textured;  // how many photometric points are in use, as the device knows; null: all
  double guess[12];  // T_world_camera: rotation row by row, then translation
  AlignSettings settings;
  std::int32_t device;
  std::int32_t room;  // points at most
  std::int32_t least_textured;  // with `textured`: with fewer there is no photometric part
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
  kTextured,                           // photometric points in use
  kMatched, kMedianSquared, kMatchedDepth,  // see TrackJob::looks; else unchanged
  kAlignResults
};

// Grey values of a frame to be made at reduced resolution, h = height / shrink rows of w = width / shrink pixels.
struct GreyJob {
  const std::uint8_t* color;  // [height, width, 3]
  const float* depth;         // [height, width], metres, 0 where unknown
  float* pixels;              // [h, w, 4] as of PhotometricReferenceView
  float* points;              // [most_points, 3] textured ones, evenly thinned, camera frame
  float* intensity;           // [most_points]
  std::int32_t* count;        // of these; null: they are not wanted
  void* workspace;            // see grey_workspace
  double fx, fy, cx, cy;      // of the reduced image
  float blur_side, blur_middle;  // weights of three neighbours by which grey values are smoothed
  float min_squared_gradient;    // of a textured point
  std::int32_t width, height, shrink, most_points;
};

// All the work that tracking has with an alignment: what is wanted of its parts, one after the other.
struct TrackJob {
  DepthPointsJob points;
  GreyJob reference, greys;
  VoxelLevelJob fine, coarse;
  AlignJob align;
  MoverEvidenceJob evidence;
  double* results;  // [kAlignResults] in page-locked memory of the host, a copy of those of `align`
  std::int32_t makes_points, makes_reference, makes_greys, makes_levels, makes_evidence;
  // Whether to tell of the matched points how many they are, and the medians of their squared distances and of their
  // depths.
  std::int32_t looks;
};

}  // namespace ggslam::cuda

// Bytes of memory that depth_points works in. Asks for columns and rows.
GGSLAM_EXPORT std::int64_t ggslam_cuda_depth_points_bytes(const ggslam::cuda::DepthPointsJob* job);

// Points of a depth image, their number and their median depth.
GGSLAM_EXPORT int ggslam_cuda_depth_points(const ggslam::cuda::DepthPointsJob* job);

// Puts blocks into the hash table of a level, which has more places than there are blocks, and their voxels where they
// belong; gives these their shapes if they have none yet.
GGSLAM_EXPORT int ggslam_cuda_voxel_level(const ggslam::cuda::VoxelLevelJob* job);

// Bytes of memory that an alignment works in; the caller sets them to zero before the first one. Asks for room,
// settings and the number of textured points.
GGSLAM_EXPORT std::int64_t ggslam_cuda_align_bytes(const ggslam::cuda::AlignJob* job);

// Aligns points to a target from a guess.
GGSLAM_EXPORT int ggslam_cuda_align(const ggslam::cuda::AlignJob* job);

// Bytes of memory that making grey values works in. Asks for width, height and shrink.
GGSLAM_EXPORT std::int64_t ggslam_cuda_grey_bytes(const ggslam::cuda::GreyJob* job);

// Makes what is wanted and not there yet, aligns, and waits for the results.
GGSLAM_EXPORT int ggslam_cuda_track_wait(const ggslam::cuda::TrackJob* job);
