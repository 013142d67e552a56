// SPDX-License-Identifier: Apache-2.0
// What a view's depth says of other places: it looks through them, shows them, or has something before them.
#pragma once
#include <cstdint>

#include "abi/export.hpp"

namespace ggslam {

// How far depths z of one surface may differ: max(least, share * z) + sigmas * (constant + square * z^2), metres.
struct SightMargin {
  double least, share;              // errors of poses and surfaces
  double sigmas, constant, square;  // the depth camera's noise
};

// What a view says of a place; from THROUGH on in the order in which places lie along a ray.
enum SightCode : int {
  kOutside = 0,  // nothing: the place is not in the image
  kUnknown = 1,  // nothing: its pixel has no depth
  kThrough = 2,  // the place is before all that is seen about its pixel, all of which is known
  kBefore = 3,   // before what its pixel shows, but beside an outline or a hole
  kSame = 4,     // what its pixel shows
  kBehind = 5,   // behind what its pixel shows, but beside an outline or a hole
  kHidden = 6,   // behind all that is seen about its pixel, all of which is known
};

// A view, and the points that it is asked about.
struct SightJob {
  const float* depth;          // [height, width], metres, 0 where unknown
  const float* near;           // the least depth of each pixel and those about it, 0 where one of them is unknown
  const float* far;            // the greatest
  int32_t height, width;
  double fx, fy, cx, cy;
  double T_camera_world[12];   // rows of [R t]
  SightMargin margin;
  const double* points;        // [count, 3], world; null: the view's own pixels are asked about, at the depths...
  const float* depths;         // ...[count = height * width], metres, 0 where unknown
  int64_t count;
  // Results [count]: a SightCode each, the pixel (row * width + column, 0 if outside), the depth in the camera's frame.
  uint8_t* codes;
  int32_t* pixels;
  double* z;
};

// A depth image of a camera, and its pose.
struct LocatedDepth {
  const float* depth;         // [height, width], metres, 0 where unknown
  double T_world_camera[12];  // rows of [R t]
};

// The newest view of a camera and some before it, compared with one another to find what is fixed to the camera.
struct FixedToCameraJob {
  LocatedDepth newest;
  const LocatedDepth* earlier;
  int32_t count;       // of them
  int32_t height, width;
  double fx, fy, cx, cy;
  SightMargin same;    // how far depths of one surface may differ
  SightMargin past;    // how much farther what is seen has to be at a place that is looked past
  double least_shift;  // in pixels, of a part of the world from one view to the other: with less, it says nothing
  // Results [3, height, width]: to each is added how many of the 2 `count` comparisons say of a pixel that its surface is
  // fixed to the camera; that its depth is what it was there in the image; that it is where a part of the world has to be.
  int32_t* counts;
};

// What a depth image [height, width] has about places `factor` pixels apart. Place (i, j) stands for the pixels
// [i factor, (i + 1) factor) x [j factor, (j + 1) factor); h = height / factor, w = width / factor.
struct DepthPlacesJob {
  const float* depth;  // metres, 0 where unknown
  int32_t height, width, factor;
  int32_t reach;       // the sums are over (2 reach + 1)^2 pixels about the middle one; beyond the image it is mirrored
  // Float [h, w] each: the nearest known depth (infinite if none is), the farthest, and the least, 0 where one is not
  // known; how many are known about the place, the sum of their depths and of the squares.
  float* nearest;
  float* farthest;
  float* least;
  float* count;
  float* total;
  float* squares;
};

// A view's places, as `DepthPlacesJob` has them: [height, width] each.
struct PlacesView {
  const float* depth;     // metres, 0 where unknown
  const float* near;      // the nearest depth about each
  const float* far;       // ...and the farthest
  const uint8_t* whole;   // not 0 where depth is known all about
  const uint8_t* smooth;  // not 0 where depths are means
  int32_t height, width;
  float fx, fy, cx, cy;   // of the small image
};

// Another view of the same world.
struct OtherPlacesView {
  PlacesView places;
  float T_this_view[12];  // rows of [R t]: from the camera of the view that is asked about to this one's
};

// How far depths of one surface may differ. Of the noise's part counts a share: `rough` where one of two views is not
// smooth, else measured: `nearest` times what the median tells of every `every`th place that is smooth in both, within
// [least_share, rough]; `rough` with fewer than `fewest`.
struct PlacesRule {
  SightMargin margin;
  float rough, least_share, nearest;
  int32_t every, fewest;
};

// What other views say of the places of a view.
struct PlacesEvidenceJob {
  PlacesView view;
  const OtherPlacesView* others;
  int32_t count;  // of them
  const uint8_t* moved;    // [height, width] of `view`, not 0: says nothing of how depths differ; may be null
  PlacesRule rule;
  // Results [count, 5, height, width], 0 or 1: the other view looked past the place; by twice the margin; this, and both
  // smooth; saw a surface there; sees nothing but others.
  uint8_t* found;
};

// Places of a view that another one looks past, in parts of which enough lies in some voxels.
struct PassedPlaces {
  int32_t all, largest;  // in all such parts, and in the largest one
};

// What a newer view says of earlier ones where it looks past places of theirs that lie in some voxels.
struct PassedVoxelsJob {
  const PlacesView* earlier;      // [count], all of one size
  const double* T_world_earlier;  // [count, 12] rows of [R t]
  const float* T_newest_earlier;  // [count, 12]
  int32_t count;
  PlacesView newest;
  const int64_t* voxels;  // [voxel_count] sorted keys: floor(coordinate / voxel) + 2^20 of x, y, z in 21 bits each, x in
  int64_t voxel_count;    // the highest
  double voxel;           // edge, metres
  double least_seeds;     // share of a part, of connected places that are looked past, that lies in the voxels
  PlacesRule rule;
  // Results. [count]; and [count, 5, height, width], as of `PlacesEvidenceJob`, of views with such places.
  PassedPlaces* passed;
  uint8_t* found;
};

}  // namespace ggslam

// Each returns 0. Images are not empty, and `factor` is at most their sides.
GGSLAM_EXPORT int ggslam_sight(void* context, const ggslam::SightJob* job);
GGSLAM_EXPORT int ggslam_fixed_to_camera(const ggslam::FixedToCameraJob* job);

// Depth `factor` times smaller: of the pixels of each place, as of `DepthPlacesJob`, the nearest known depth, 0 if none
// is; `smaller`: [h, w].
GGSLAM_EXPORT int ggslam_shrink_depth(const float* depth, int32_t height, int32_t width, int32_t factor, float* smaller);
GGSLAM_EXPORT int ggslam_depth_places(void* context, const ggslam::DepthPlacesJob* job);
GGSLAM_EXPORT int ggslam_places_evidence(void* context, const ggslam::PlacesEvidenceJob* job);
GGSLAM_EXPORT int ggslam_passed_voxels(void* context, const ggslam::PassedVoxelsJob* job);
