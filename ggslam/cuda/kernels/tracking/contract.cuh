// SPDX-License-Identifier: Apache-2.0
// The arguments of the tracking functions. All pointers lead to device memory. ggslam/tracking/cuda/contract.py mirrors
// the structures field by field; those named *Settings and PhotometricReferenceView are the compiled core's
// (native/src/tracking/tracking_types.hpp), so that one mirror serves both.
#pragma once
#include "common/platform.cuh"

namespace ggslam::cuda {

// --- points of a depth image -------------------------------------------------------------------------------------

struct DepthPointsSettings {
  float fx, fy, cx, cy;                 // pixels; the centre of the top-left pixel is (0, 0)
  float noise_constant, noise_square;   // sigma(z) = constant + square z^2, metres
  float min_depth, max_depth;           // metres
  float min_thickness, max_elongation;  // of the regularised covariance
  float min_neighbours;                 // share of the window that must lie on the same surface
  std::int32_t width, height;
  std::int32_t stride;       // pixels between points
  std::int32_t window;       // the window has (2 window + 1)^2 samples
  std::int32_t window_step;  // pixels between samples of the window
};

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

struct DepthPointsJob {
  const float* depth;  // [height, width]
  PointArrays out;     // room for columns * rows points
  void* workspace;     // room for a bit for each grid point, in whole words of 32
  void* stream;
  DepthPointsSettings settings;
  std::int32_t device, columns, rows;  // of the grid
};

// --- what points are aligned to ------------------------------------------------------------------------------------

struct alignas(16) Voxel {
  float mean[3];
  float weight;
  float normal[3];
  float reserved;
  float covariance[6];  // regularised: median eigenvalue 1
  float padding[2];
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

struct VoxelLevel {
  const Voxel* voxels;
  VoxelSlot* slots;
  std::uint64_t slot_mask;  // number of slots, a power of two, minus one
  float size, inverse_size;  // of a voxel, metres
};

struct TargetSettings {
  float voxel;  // edge of a fine voxel, metres
  float min_opacity_logit;
  float min_thickness, max_thickness, max_elongation;  // of a voxel's regularised covariance
  float scatter_weight;    // weight of the scatter of the means against the members' own covariances
  float neighbour_weight;  // weight of the 26 neighbours in a voxel's scatter
};

// Sums over the members of a voxel, see the core.
struct VoxelMoments {
  float weight;
  float offset[3];  // sum of w (mean - centre)
  float outer[6];   // sum of w (mean - centre)(mean - centre)^T
  float own[6];     // sum of w C with C the members' regularised covariances
  float normal[3];
  float centre[3];
};

struct VoxelLevelJob {
  const VoxelBlock* blocks;
  const VoxelMoments* moments;  // null: the voxels are finished
  VoxelLevel level;
  Voxel* voxels;  // those of the level, to be finished
  void* stream;
  TargetSettings settings;
  std::int32_t device, block_count, voxel_count;
};

// --- alignment -------------------------------------------------------------------------------------------------------

struct AlignSettings {
  double translation_tolerance, rotation_tolerance;  // metres, radians
  double coarse_kernel_factor;  // the robust kernel of the coarse level is this much wider
  float noise_constant, noise_square;
  float kernel_constant, kernel_sigmas;    // width of the Geman-McClure kernel: constant + sigmas sigma(z)
  float overlap_constant, overlap_sigmas;  // a match is an inlier under this point-to-plane distance, likewise
  float min_normal_dot;                    // normals of a match agree to this cosine
  float plane_variance;                    // variance of a match along the normal, units of the regularised covariances
  std::int32_t coarse_iterations, fine_iterations, coarse_points, min_matches;
  float photometric_weight;  // factor of the photometric part
  float huber;               // grey levels in [0, 1]
  float depth_tolerance;     // relative depth difference above which a pixel is occluded
};

struct PhotometricPoints {
  const float* points;     // [n, 3] frame's camera
  const float* intensity;  // [n] grey in [0, 1]
  std::int32_t count;
};

struct PhotometricReferenceView {
  const float* pixels;  // [h, w, 4] grey, d grey / du, d grey / dv, depth
  float fx, fy, cx, cy;
  std::int32_t width, height;
  float rotation[9], translation[3];  // T_reference_world
};

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
