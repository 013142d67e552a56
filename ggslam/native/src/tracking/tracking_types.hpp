// SPDX-License-Identifier: Apache-2.0
// Plain structures shared by the tracking kernels (compiled per instruction set) and their callers. The structures
// named *Settings and *Result are mirrored field by field in ggslam/tracking/native.py.
#pragma once
#include <cstddef>
#include <cstdint>

namespace ggslam {

// --- points of a depth image ------------------------------------------------------------------------------------

struct DepthPointsSettings {
  float fx, fy, cx, cy;                // pixels; the centre of the top-left pixel is (0, 0)
  float noise_constant, noise_square;  // sigma(z) = constant + square z^2, metres
  float min_depth, max_depth;          // metres
  float min_thickness, max_elongation;  // of the regularised covariance, see regularized_axes()
  float min_neighbours;                // share of the window that must lie on the same surface
  int32_t width, height;
  int32_t stride;       // pixels between points
  int32_t window;       // the window has (2 window + 1)^2 samples
  int32_t window_step;  // pixels between samples of the window
};

struct DepthPointsOutput {
  float* points;       // [n, 3] camera frame, metres
  float* normals;      // [n, 3] unit, towards the camera
  float* covariances;  // [n, 6] xx xy xz yy yz zz, median eigenvalue 1
  int32_t* pixels;     // [n, 2] u, v
  float* weights;      // [n] (sigma(1 m) / sigma(z))^2
};

// --- voxel grid the points are aligned to --------------------------------------------------------------------------

struct TargetInput {
  const float* means;           // [n, 3]
  const float* quaternions;     // [n, 4] wxyz
  const float* log_scales;      // [n, 3]
  const float* opacity_logits;  // [n]
  const int32_t* birth;         // [n] row of camera_positions, or negative: not known
  const float* camera_positions;  // [cameras, 3]
  int32_t count, cameras;
};

struct TargetSettings {
  float voxel;              // edge of a fine voxel, metres; coarse voxels are 4 times as wide
  float min_opacity_logit;
  float min_thickness, max_thickness, max_elongation;
  float scatter_weight;     // weight of the scatter of the means against the members' own covariances
  float neighbour_weight;   // weight of the 26 neighbours in a voxel's scatter
};

struct VoxelMoments {
  float weight;
  float offset[3];         // sum of w (mean - centre)
  float outer[6];          // sum of w (mean - centre)(mean - centre)^T
  float own[6];            // sum of w C with C the members' regularised covariances
  float normal[3];         // sum of w (1 - thickness) n
  float centre[3];
};

struct alignas(64) Voxel {
  float mean[3];
  float weight;
  float normal[3];
  float reserved;
  float covariance[6];     // regularised: median eigenvalue 1
  float padding[2];
};

// Voxels are grouped in blocks of 4 x 4 x 4; those of a block lie one after the other in the order of their bits.
struct VoxelBlock {
  uint64_t occupied;  // bit x + 4 y + 16 z
  uint32_t first;     // index of the voxel of the lowest bit
  uint32_t reserved;
};

struct VoxelLevelView {
  const Voxel* voxels;
  const VoxelBlock* blocks;
  const uint64_t* slot_key;   // open addressing, capacity slot_mask + 1; kEmptyKey marks a free slot
  const int32_t* slot_block;
  uint64_t slot_mask;
  float size, inverse_size;
  int32_t count;
};

constexpr uint64_t kEmptyKey = ~uint64_t{0};

inline uint64_t block_key(int x, int y, int z) {
  constexpr uint64_t kMask = (uint64_t{1} << 21) - 1;
  return (static_cast<uint64_t>(x + (1 << 20)) & kMask) | (static_cast<uint64_t>(y + (1 << 20)) & kMask) << 21 |
         (static_cast<uint64_t>(z + (1 << 20)) & kMask) << 42;
}

inline uint64_t hash_key(uint64_t key) {
  key *= 0x9E3779B97F4A7C15ull;
  key ^= key >> 32;
  key *= 0xD6E8FEB86659FD93ull;
  return key ^ (key >> 32);
}

// --- alignment -----------------------------------------------------------------------------------------------------

struct AlignSettings {
  double translation_tolerance, rotation_tolerance;  // metres, radians
  double coarse_kernel_factor;   // the robust kernel of the coarse level is this much wider
  float noise_constant, noise_square;
  float kernel_constant, kernel_sigmas;    // width of the Geman-McClure kernel: constant + sigmas sigma(z)
  float overlap_constant, overlap_sigmas;  // a match is an inlier under this point-to-plane distance, likewise
  float min_normal_dot;          // normals of a match agree to this cosine
  float plane_variance;          // variance of a match along the normal in units of the regularised covariances
  int32_t coarse_iterations, fine_iterations, coarse_points, min_matches;
  float photometric_weight;      // factor of the photometric part
  float huber;                   // grey levels in [0, 1]
  float depth_tolerance;         // relative depth difference above which a pixel is occluded
};

struct AlignPoints {
  const float* points;
  const float* normals;
  const float* covariances;
  const float* weights;
  int32_t count;
};

// Sums over a block of points, in the order of AlignSums::h: upper triangle of the 6x6 matrix row by row.
struct AlignSums {
  double h[21];
  double b[6];
  double cost;
  double matches;
};

struct PlaneSums {
  double information[21];
  double inliers, squared;  // number, sum of squared point-to-plane distances
};

// One linearisation: points [begin, end) of `points` against `level` at the pose.
struct LinearizeArgs {
  AlignPoints points;
  VoxelLevelView level;
  AlignSettings settings;
  float kernel_factor;
  float rotation[9], translation[3];  // T_world_camera
  int32_t point_step;                 // every point_step-th point is used
  int32_t* match;                     // [n] voxel, or -1
  float* squared_distance;            // [n] squared point-to-plane distance, or +inf
  float* searched_at;                 // [n, 3] where `match` was searched from; NaN: not yet. Null: search always
};

// --- photometric part ------------------------------------------------------------------------------------------------

struct PhotometricPoints {
  const float* points;     // [n, 3] frame's camera
  const float* intensity;  // [n] grey in [0, 1]
  int32_t count;
};

struct PhotometricReferenceView {
  const float* pixels;  // [h, w, 4] grey, d grey / du, d grey / dv, depth
  float fx, fy, cx, cy;
  int32_t width, height;
  float rotation[9], translation[3];  // T_reference_world
};

struct PhotometricArgs {
  PhotometricPoints points;
  PhotometricReferenceView reference;
  float rotation[9], translation[3];  // T_world_camera
  float gain, bias;                   // I_reference = gain I_frame + bias
  float huber, depth_tolerance;
};

struct PhotometricSums {
  double h[36];  // upper triangle of 8x8: twist, gain, bias
  double b[8];
  double cost, count, absolute;
};

struct AlignResult {
  double pose[16];         // T_world_camera, row by row
  double normal_matrix[36];  // of the last linearisation, twist about the camera centre, world axes
  double information[36];  // point-to-plane, 1 / sigma^2, twist about the camera centre
  double cost;             // per unit of weight
  double overlap, rmse;    // share of all points; metres
  double photometric_residual, photometric_share, gain, bias;
  int32_t coarse_iterations, fine_iterations, matches, inliers, converged, usable;
};

}  // namespace ggslam
