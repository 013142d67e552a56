// SPDX-License-Identifier: Apache-2.0
// The compiled core's tracking: points of a depth image, the voxels they are aligned to, alignment.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/export.hpp"

namespace ggslam {

// How points are taken from a depth image.
struct DepthPointsSettings {
  float fx, fy, cx, cy;                // pixels; the centre of the top-left pixel is (0, 0)
  float noise_constant, noise_square;  // sigma(z) = constant + square z^2, metres
  float min_depth, max_depth;          // metres
  float min_thickness, max_elongation;  // of the regularised covariance, see regularized_axes()
  float min_neighbours;                // share of the window that must lie on the same surface
  float max_weight;                    // of a point
  int32_t width, height;
  int32_t stride;       // pixels between points
  int32_t window;       // the window has (2 window + 1)^2 samples
  int32_t window_step;  // pixels between samples of the window
};

// Points to write.
struct DepthPointsOutput {
  float* points;       // [n, 3] camera frame, metres
  float* normals;      // [n, 3] unit, towards the camera
  float* covariances;  // [n, 6] xx xy xz yy yz zz, median eigenvalue 1
  int32_t* pixels;     // [n, 2] u, v
  float* weights;      // [n] (sigma(1 m) / sigma(z))^2, at most max_weight
};

// Gaussians of a map.
struct TargetInput {
  const float* means;           // [n, 3]
  const float* quaternions;     // [n, 4] wxyz
  const float* log_scales;      // [n, 3]
  const float* opacity_logits;  // [n]
  const int32_t* birth;         // [n] row of camera_positions, or negative: not known
  const float* camera_positions;  // [cameras, 3]
  int32_t count, cameras;
};

// How Gaussians are gathered in voxels.
struct TargetSettings {
  float voxel;              // edge of a fine voxel, metres; coarse voxels are 4 times as wide
  float min_opacity_logit;
  float min_thickness, max_thickness, max_elongation;
  float scatter_weight;     // weight of the scatter of the means against the members' own covariances
  float neighbour_weight;   // weight of the 26 neighbours in a voxel's scatter
};

// Sums over the members of a voxel.
struct VoxelMoments {
  float weight;
  float offset[3];  // sum of w (mean - centre)
  float outer[6];   // sum of w (mean - centre)(mean - centre)^T
  float own[6];     // sum of w C with C the members' regularised covariances
  float normal[3];  // sum of w (1 - thickness) n
  float centre[3];
};

// A voxel of a target.
struct alignas(64) Voxel {
  float mean[3];
  float weight;
  float normal[3];
  float reserved;
  float covariance[6];  // regularised: median eigenvalue 1
  float padding[2];
};

// A target that somebody has a copy of.
struct TargetCopy {
  uint64_t number;    // which; 0: none
  uint32_t version;   // of a growing target
  int32_t finished;   // whether the copy is of voxels with shapes; else of their moments
};

// What a copy lacks of one level, and where it is.
struct LevelChanges {
  int64_t values_at, blocks_at, indices_at;  // bytes from the beginning: see ggslam_gicp_target_changes
  int32_t voxel_count, block_count;          // that the copy lacks
  int32_t all_blocks;                        // of the level
  int32_t places;                            // voxels of the level have indices below
};

// What a copy lacks of a target.
struct TargetChanges {
  TargetCopy target;  // what it is a copy of then
  int32_t whole;      // whether that is everything: the copy is of another target
  LevelChanges fine, coarse;
};

// How points are aligned to voxels.
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

// The points of a frame, as DepthPointsOutput has them.
struct AlignPoints {
  const float* points;
  const float* normals;
  const float* covariances;
  const float* weights;
  const float* depths;  // [n] along the axis of the camera that saw each, of which their noise follows; null: points' z
  int32_t count;
};

// Points whose grey is compared.
struct PhotometricPoints {
  const float* points;     // [n, 3] frame's camera
  const float* intensity;  // [n] grey in [0, 1]
  int32_t count;
};

// What their grey is compared with.
struct PhotometricReferenceView {
  const float* pixels;  // [h, w, 4] grey, d grey / du, d grey / dv, depth
  float fx, fy, cx, cy;
  int32_t width, height;
  float rotation[9], translation[3];  // T_reference_world
};

// What an alignment found.
struct AlignResult {
  double pose[16];         // T_world_camera, row by row
  double normal_matrix[36];  // of the last linearisation, twist about the camera centre, world axes
  double information[36];  // point-to-plane, 1 / sigma^2, twist about the camera centre
  double cost;             // per unit of weight
  double overlap, rmse;    // share of all points; metres
  double photometric_residual, photometric_share, gain, bias;
  int32_t coarse_iterations, fine_iterations, matches, inliers, converged, usable;
};

// Where a camera may have stood still since an earlier frame, the anchor: the pixels that tell, and what they say.
struct StillPixelsJob {
  // Four images [height, width] each: grey values, blurred; their gradients along rows and along columns, grey levels a
  // pixel; depth, metres, 0 where unknown.
  const float* anchor;
  const float* now;
  int32_t height, width;
  float least_squared_gradient;  // of a textured pixel, exclusive
  float largest_flow;            // pixels across its edge, of a pixel that stays
  int32_t fewest, most;          // textured pixels with depth in both images; of `most` and more some are compared
  int32_t cells;                 // parts of the image along each axis
  int32_t fewest_in_cell;        // compared pixels of a part that counts
  double still_cells;            // smallest share of these parts in which...
  double still_share;            // ...at least this share of the pixels stays; the same for each direction
  float across;                  // least component of a unit gradient along a direction that it tells about
  int32_t fewest_across;         // such pixels of each direction
  // Results, room for 2 `most`: of each compared pixel 2 (row * width + column) and, if it stays, 1 more.
  int32_t* found;
};

}  // namespace ggslam

// Points on the grid of pixels `stride` apart, row by row; returns their number. The outputs have room for
// ceil(width / stride) ceil(height / stride) points.
GGSLAM_EXPORT int ggslam_depth_points(void* context, const float* depth, const ggslam::DepthPointsSettings* settings,
                                      const ggslam::DepthPointsOutput* out);

// Copies a depth image of `count` pixels to `copy`; returns how many of them are known, that is greater than 0.
GGSLAM_EXPORT int64_t ggslam_copy_depth(const float* depth, int64_t count, float* copy);

// Grey values 0 to 255 of an image [height, width, 3], of which `factor`, 1 to 16, divides both sides, `factor` times
// smaller: means of squares of pixels and then of channels (by their luminance), each rounded as OpenCV does, `grey` [h, w].
GGSLAM_EXPORT int ggslam_shrink_grey(const uint8_t* color, int32_t height, int32_t width, int32_t factor, float* grey);

// The number of compared pixels if most of them stay, all over the image and along each of four directions, else 0.
GGSLAM_EXPORT int ggslam_still_pixels(const ggslam::StillPixelsJob* job);

GGSLAM_EXPORT void* ggslam_gicp_target_create();
GGSLAM_EXPORT int ggslam_gicp_target_destroy(void* target);
GGSLAM_EXPORT int ggslam_gicp_target_build(void* context, void* target, const void* base,
                                           const ggslam::TargetInput* input, const ggslam::TargetSettings* settings);

// As ggslam_gicp_target_build without a base. The shapes of voxels that lie in `like`, a target made by one of the two,
// with the same surroundings are copied from there; the result is the same.
GGSLAM_EXPORT int ggslam_gicp_target_build_like(void* context, void* target, const void* like,
                                                const ggslam::TargetInput* input,
                                                const ggslam::TargetSettings* settings);

// As ggslam_gicp_target_build, but leaves the voxels without shapes. Until ggslam_gicp_target_finish has been called, the
// target may be a base, and be asked for its size and for what a copy of its moments lacks.
GGSLAM_EXPORT int ggslam_gicp_target_gather(void* context, void* target, const void* base,
                                            const ggslam::TargetInput* input, const ggslam::TargetSettings* settings);
GGSLAM_EXPORT int ggslam_gicp_target_finish(void* context, void* target, const ggslam::TargetSettings* settings);

// Number of voxels of a level (0 fine, 1 coarse).
GGSLAM_EXPORT int ggslam_gicp_target_size(const void* target, int level);

// Copies a level's voxels, [n, 16] in the order of struct Voxel.
GGSLAM_EXPORT int ggslam_gicp_target_voxels(const void* target, int level, float* out);

// Copies the unit normals of some fine voxels by the index that alignments give, [n, 3]; zero where it is negative.
GGSLAM_EXPORT int ggslam_gicp_target_normals(const void* target, const int32_t* voxels, int64_t count, float* out);

// What a copy of a target lacks, with shapes if `finished`: to `out`, which has `room` bytes, if that is enough; returns the
// bytes needed. Of each level values: of voxels (struct Voxel, or struct VoxelMoments); blocks: key, occupied, first, of
// each that changed, whose voxels are the values in the same order; indices: where each value belongs, int32.
GGSLAM_EXPORT int64_t ggslam_gicp_target_changes(const void* target, const ggslam::TargetCopy* copy, int finished,
                                                 void* out, int64_t room, ggslam::TargetChanges* changes);

// Uses no thread but the caller's.
GGSLAM_EXPORT void* ggslam_target_part_create(const void* context, const ggslam::TargetInput* input,
                                              const ggslam::TargetSettings* settings, uint64_t rank);
GGSLAM_EXPORT int ggslam_target_part_destroy(void* part);
GGSLAM_EXPORT int64_t ggslam_target_part_bytes(const void* part);

// `before` may be null; `target` is neither it nor in use.
GGSLAM_EXPORT int ggslam_gicp_target_compose(void* context, void* target, const void* before, const void* const* parts,
                                             int count, const ggslam::TargetSettings* settings);

// Aligns points to a target from the guess `pose` (T_world_camera, row by row). `photometric_points` and `reference`
// may be null. `match` and `squared_distance` have room for one entry per point.
GGSLAM_EXPORT int ggslam_gicp_align(void* context, const void* target, const ggslam::AlignPoints* points,
                                    const ggslam::AlignSettings* settings,
                                    const ggslam::PhotometricPoints* photometric_points,
                                    const ggslam::PhotometricReferenceView* reference, const double* pose_guess,
                                    int32_t* match, float* squared_distance, ggslam::AlignResult* result);

// One linearisation at a pose, for tests: level 0 fine, 1 coarse. h [36], b [6] in sums over points, twist about the
// camera centre; returns the cost.
GGSLAM_EXPORT double ggslam_gicp_linearize(void* context, const void* target, const ggslam::AlignPoints* points,
                                           const ggslam::AlignSettings* settings, int level, const double* pose,
                                           int32_t* match, float* squared_distance, double* h, double* b);
