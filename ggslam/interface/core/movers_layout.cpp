// SPDX-License-Identifier: Apache-2.0
// Written by scripts/tools/make_native_mirrors.py from movers.hpp; changes are lost. Size of each structure and
// offsets of its fields, in the order of the header, so that a caller can check its mirrors of them.
#include <cstddef>
#include <cstdint>

#include "interface/core/movers.hpp"

using ggslam::DepthPlacesJob;
using ggslam::OtherPlacesView;
using ggslam::PlacesEvidenceJob;
using ggslam::PlacesView;

namespace {
constexpr std::size_t kLayout[] = {
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
    offsetof(PlacesEvidenceJob, count), offsetof(PlacesEvidenceJob, moved), offsetof(PlacesEvidenceJob, margin_least),
    offsetof(PlacesEvidenceJob, margin_sigmas), offsetof(PlacesEvidenceJob, noise_constant),
    offsetof(PlacesEvidenceJob, noise_square), offsetof(PlacesEvidenceJob, rough),
    offsetof(PlacesEvidenceJob, least_share), offsetof(PlacesEvidenceJob, nearest), offsetof(PlacesEvidenceJob, every),
    offsetof(PlacesEvidenceJob, fewest), offsetof(PlacesEvidenceJob, found),
};
}  // namespace

GGSLAM_EXPORT const std::size_t* ggslam_movers_layout(int* count) {
  *count = static_cast<int>(sizeof(kLayout) / sizeof(kLayout[0]));
  return kLayout;
}
