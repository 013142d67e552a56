// SPDX-License-Identifier: Apache-2.0
// The compiled core's comparison of depth images, by which movers are found.
#pragma once
#include <cstdint>

#include "interface/export.hpp"

namespace ggslam {

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

// What other views say of the places of a view.
struct PlacesEvidenceJob {
  PlacesView view;
  const OtherPlacesView* others;
  int32_t count;  // of them
  const uint8_t* moved;    // [height, width] of `view`, not 0: says nothing of how depths differ; may be null
  // What depths z of one surface may differ by: margin_least + margin_sigmas * share * (noise_constant +
  // noise_square * z^2), share being `rough` where one of the views is not smooth, else measured: `nearest` times what
  // the median tells of every `every`th smooth place, within [least_share, rough]; `rough` with fewer than `fewest`.
  float margin_least, margin_sigmas, noise_constant, noise_square;
  float rough, least_share, nearest;
  int32_t every, fewest;
  // Results [count, 5, height, width], 0 or 1: the other view looked past the place; by twice the margin; this, and both
  // smooth; saw a surface there; sees nothing but others.
  uint8_t* found;
};

}  // namespace ggslam

// Each returns 0. Images are not empty, and `factor` is at most their sides.
GGSLAM_EXPORT int ggslam_depth_places(void* context, const ggslam::DepthPlacesJob* job);
GGSLAM_EXPORT int ggslam_places_evidence(void* context, const ggslam::PlacesEvidenceJob* job);
