// SPDX-License-Identifier: Apache-2.0
// Parts of what `abi/core/sight.hpp` describes.
#pragma once
#include <cstddef>
#include <vector>

#include "common/dispatch.hpp"
#include "abi/core/sight.hpp"

namespace ggslam {

// A row's sums for each column of the image: of a window's rows, and of a place's own.
struct DepthColumns {
  double* total;
  double* squares;
  float* count;
  float* nearest;
  float* farthest;
  float* least;
};

// The places of a view in another one; arrays of one element a place.
struct ProjectedPlaces {
  float* u;
  float* v;
  float* z;
  float* near;      // what the other view has there...
  float* far;
  int* where;       // ...at this place, -1 without one
  uint8_t* known;   // 1: it knows what is about it
  uint8_t* smooth;  // 1: and both views are smooth there
};

// Standard deviation of a pixel's depth at depth z, metres.
template <class T>
static inline T sigma_at(const SightMargin& m, T z) {
  return static_cast<T>(m.constant) + static_cast<T>(m.square) * z * z;
}

// How far depths z of one surface may differ, metres; `noise_share`: of the noise that is left in means.
template <class T>
static inline T margin_at(const SightMargin& m, T z, T noise_share) {
  const T least = static_cast<T>(m.least), of_distance = static_cast<T>(m.share) * z;
  return (of_distance > least ? of_distance : least) + static_cast<T>(m.sigmas) * noise_share * sigma_at(m, z);
}

// Refuse what cannot be.
void check_margin(const SightMargin& margin);
void check_rule(const PlacesRule& rule);
void check_view(const char* name, const PlacesView& view);

// How large differences between means of depth are, in standard deviations of a pixel, as most of them are. `moved`: see
// `PlacesEvidenceJob`.
float measured_share(const PlacesRule& rule, const uint8_t* moved, const PlacesView& other,
                     const ProjectedPlaces& places, std::size_t count);

// Memory for one thread's places of a view in another one.
class PlacesScratch {
 public:
  ProjectedPlaces places(std::size_t count) {
    floats_.resize(5 * count), where_.resize(count), flags_.resize(2 * count);
    float* f = floats_.data();
    return {f, f + count, f + 2 * count, f + 3 * count, f + 4 * count, where_.data(), flags_.data(),
            flags_.data() + count};
  }

 private:
  std::vector<float> floats_;
  std::vector<int> where_;
  std::vector<uint8_t> flags_;
};

// A row of an image as if it were mirrored at its borders, without repeating them.
inline int mirrored(int i, int count) {
  if (count == 1) return 0;
  while (i < 0 || i >= count) i = i < 0 ? -i : 2 * (count - 1) - i;
  return i;
}

}  // namespace ggslam

// Places of row `row`; `columns`: scratch, `width` elements each.
GGSLAM_DECLARE_KERNEL(void depth_places_row(const DepthPlacesJob& job, int row, const DepthColumns& columns))
// A row of places `factor` times smaller, of `factor` rows of depth; `nearest`: scratch, `width` elements.
GGSLAM_DECLARE_KERNEL(void shrink_depth_row(const float* depth, int width, int factor, float* nearest, float* smaller))
// Where places of a view fall in another one: u, v, z and where.
GGSLAM_DECLARE_KERNEL(void project_places(const PlacesView& view, const OtherPlacesView& other,
                                          const ProjectedPlaces& places))
// What the other one has there: near, far, known and smooth.
GGSLAM_DECLARE_KERNEL(void look_up_places(const PlacesView& view, const PlacesView& other,
                                          const ProjectedPlaces& places))
// Flags the places that the other view may look past, whatever share of the noise is measured; `beyond`: what is near
// about each place of the other view where it is whole, 0 elsewhere.
GGSLAM_DECLARE_KERNEL(void flag_perhaps_passed(const PlacesRule& rule, const PlacesView& view, const float* beyond,
                                               const ProjectedPlaces& places, uint8_t* flags))
// The results by one other view, [5, count]; `share`: of a pixel's noise, where both views are smooth.
GGSLAM_DECLARE_KERNEL(void judge_places(const PlacesRule& rule, float share, std::size_t count,
                                        const ProjectedPlaces& places, uint8_t* found))
// What a view says of the points, or of its own pixels, [begin, end).
GGSLAM_DECLARE_KERNEL(void classify_places(const SightJob& job, std::size_t begin, std::size_t end))
