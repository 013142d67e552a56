// SPDX-License-Identifier: Apache-2.0
// Written by scripts/tools/make_native_mirrors.py from sight.hpp; changes are lost. Size of each structure and
// offsets of its fields, in the order of the header, so that a caller can check its mirrors of them.
#include <cstddef>
#include <cstdint>

#include "interface/core/sight.hpp"

using ggslam::DepthPlacesJob;
using ggslam::OtherPlacesView;
using ggslam::PlacesEvidenceJob;
using ggslam::PlacesView;
using ggslam::SightJob;
using ggslam::SightMargin;

namespace {
constexpr std::size_t kLayout[] = {
    sizeof(SightMargin), offsetof(SightMargin, least), offsetof(SightMargin, share), offsetof(SightMargin, sigmas),
    offsetof(SightMargin, constant), offsetof(SightMargin, square),
    sizeof(SightJob), offsetof(SightJob, depth), offsetof(SightJob, near), offsetof(SightJob, far),
    offsetof(SightJob, height), offsetof(SightJob, width), offsetof(SightJob, fx), offsetof(SightJob, fy),
    offsetof(SightJob, cx), offsetof(SightJob, cy), offsetof(SightJob, T_camera_world), offsetof(SightJob, margin),
    offsetof(SightJob, points), offsetof(SightJob, depths), offsetof(SightJob, count), offsetof(SightJob, codes),
    offsetof(SightJob, pixels), offsetof(SightJob, z),
    sizeof(DepthPlacesJob), offsetof(DepthPlacesJob, depth), offsetof(DepthPlacesJob, height),
    offsetof(DepthPlacesJob, width), offsetof(DepthPlacesJob, factor), offsetof(DepthPlacesJob, reach),
    offsetof(DepthPlacesJob, nearest), offsetof(DepthPlacesJob, farthest), offsetof(DepthPlacesJob, least),
    offsetof(DepthPlacesJob, count), offsetof(DepthPlacesJob, total), offsetof(DepthPlacesJob, squares),
    sizeof(PlacesView), offsetof(PlacesView, depth), offsetof(PlacesView, near), offsetof(PlacesView, far),
    offsetof(PlacesView, whole), offsetof(PlacesView, smooth), offsetof(PlacesView, height),
    offsetof(PlacesView, width), offsetof(PlacesView, fx), offsetof(PlacesView, fy), offsetof(PlacesView, cx),
    offsetof(PlacesView, cy),
    sizeof(OtherPlacesView), offsetof(OtherPlacesView, places), offsetof(OtherPlacesView, T_this_view),
    sizeof(PlacesEvidenceJob), offsetof(PlacesEvidenceJob, view), offsetof(PlacesEvidenceJob, others),
    offsetof(PlacesEvidenceJob, count), offsetof(PlacesEvidenceJob, moved), offsetof(PlacesEvidenceJob, margin),
    offsetof(PlacesEvidenceJob, rough), offsetof(PlacesEvidenceJob, least_share), offsetof(PlacesEvidenceJob, nearest),
    offsetof(PlacesEvidenceJob, every), offsetof(PlacesEvidenceJob, fewest), offsetof(PlacesEvidenceJob, found),
};
}  // namespace

GGSLAM_EXPORT const std::size_t* ggslam_sight_layout(int* count) {
  *count = static_cast<int>(sizeof(kLayout) / sizeof(kLayout[0]));
  return kLayout;
}
