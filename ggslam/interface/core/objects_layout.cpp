// SPDX-License-Identifier: Apache-2.0
// Written by scripts/tools/make_native_mirrors.py from objects.hpp; changes are lost. Size of each structure and
// offsets of its fields, in the order of the header, so that a caller can check its mirrors of them.
#include <cstddef>
#include <cstdint>

#include "interface/core/objects.hpp"

using ggslam::AlikeColorsJob;
using ggslam::BodiesJob;
using ggslam::BordersJob;
using ggslam::ContactsJob;
using ggslam::GrowthJob;
using ggslam::NormalsJob;
using ggslam::PiecesJob;
using ggslam::PixelLinks;
using ggslam::PlaneClaimJob;
using ggslam::RegionOnPlane;
using ggslam::RegionsOnPlanesJob;
using ggslam::SegmentedSurface;
using ggslam::StrangeColorsJob;
using ggslam::SurfaceLinksJob;

namespace {
constexpr std::size_t kLayout[] = {
    sizeof(SegmentedSurface), offsetof(SegmentedSurface, valid), offsetof(SegmentedSurface, depth),
    offsetof(SegmentedSurface, inverse), offsetof(SegmentedSurface, points), offsetof(SegmentedSurface, normals),
    offsetof(SegmentedSurface, height), offsetof(SegmentedSurface, width), offsetof(SegmentedSurface, step),
    offsetof(SegmentedSurface, sigma), offsetof(SegmentedSurface, gap_m), offsetof(SegmentedSurface, gap_sigmas),
    sizeof(PixelLinks), offsetof(PixelLinks, right), offsetof(PixelLinks, below),
    sizeof(NormalsJob), offsetof(NormalsJob, inverse), offsetof(NormalsJob, rays), offsetof(NormalsJob, height),
    offsetof(NormalsJob, width), offsetof(NormalsJob, step), offsetof(NormalsJob, fx), offsetof(NormalsJob, fy),
    offsetof(NormalsJob, jump), offsetof(NormalsJob, normals),
    sizeof(AlikeColorsJob), offsetof(AlikeColorsJob, colors), offsetof(AlikeColorsJob, pieces),
    offsetof(AlikeColorsJob, pixels), offsetof(AlikeColorsJob, asked), offsetof(AlikeColorsJob, means),
    offsetof(AlikeColorsJob, count), offsetof(AlikeColorsJob, limit), offsetof(AlikeColorsJob, alike),
    sizeof(StrangeColorsJob), offsetof(StrangeColorsJob, lab), offsetof(StrangeColorsJob, inside),
    offsetof(StrangeColorsJob, pieces), offsetof(StrangeColorsJob, height), offsetof(StrangeColorsJob, width),
    offsetof(StrangeColorsJob, pieces_end), offsetof(StrangeColorsJob, light), offsetof(StrangeColorsJob, bins),
    offsetof(StrangeColorsJob, cell), offsetof(StrangeColorsJob, least_cell), offsetof(StrangeColorsJob, occurs),
    offsetof(StrangeColorsJob, usual), offsetof(StrangeColorsJob, base), offsetof(StrangeColorsJob, same_hue),
    offsetof(StrangeColorsJob, darkest), offsetof(StrangeColorsJob, brightest), offsetof(StrangeColorsJob, kind),
    sizeof(SurfaceLinksJob), offsetof(SurfaceLinksJob, surface), offsetof(SurfaceLinksJob, rest),
    offsetof(SurfaceLinksJob, least_cosine), offsetof(SurfaceLinksJob, closed), offsetof(SurfaceLinksJob, smooth),
    sizeof(PiecesJob), offsetof(PiecesJob, ids), offsetof(PiecesJob, links), offsetof(PiecesJob, height),
    offsetof(PiecesJob, width), offsetof(PiecesJob, pieces),
    sizeof(GrowthJob), offsetof(GrowthJob, regions), offsetof(GrowthJob, valid), offsetof(GrowthJob, links),
    offsetof(GrowthJob, height), offsetof(GrowthJob, width), offsetof(GrowthJob, passes),
    sizeof(PlaneClaimJob), offsetof(PlaneClaimJob, surface), offsetof(PlaneClaimJob, rays_x),
    offsetof(PlaneClaimJob, rays_y), offsetof(PlaneClaimJob, planes), offsetof(PlaneClaimJob, count),
    offsetof(PlaneClaimJob, tolerance), offsetof(PlaneClaimJob, tolerance_m), offsetof(PlaneClaimJob, least_cosine),
    offsetof(PlaneClaimJob, label),
    sizeof(BordersJob), offsetof(BordersJob, surface), offsetof(BordersJob, plane_of),
    offsetof(BordersJob, plane_normals), offsetof(BordersJob, planes), offsetof(BordersJob, colors),
    offsetof(BordersJob, regions), offsetof(BordersJob, regions_end), offsetof(BordersJob, reach),
    offsetof(BordersJob, least_cosine), offsetof(BordersJob, room), offsetof(BordersJob, pairs),
    offsetof(BordersJob, counts), offsetof(BordersJob, contrast),
    sizeof(RegionOnPlane), offsetof(RegionOnPlane, region), offsetof(RegionOnPlane, plane),
    offsetof(RegionOnPlane, points), offsetof(RegionOnPlane, near_by),
    sizeof(RegionsOnPlanesJob), offsetof(RegionsOnPlanesJob, points), offsetof(RegionsOnPlanesJob, regions),
    offsetof(RegionsOnPlanesJob, pixels), offsetof(RegionsOnPlanesJob, regions_end),
    offsetof(RegionsOnPlanesJob, limit_m), offsetof(RegionsOnPlanesJob, asked), offsetof(RegionsOnPlanesJob, count),
    sizeof(BodiesJob), offsetof(BodiesJob, points), offsetof(BodiesJob, normals), offsetof(BodiesJob, regions),
    offsetof(BodiesJob, pixels), offsetof(BodiesJob, regions_end), offsetof(BodiesJob, counts),
    offsetof(BodiesJob, centres), offsetof(BodiesJob, squares), offsetof(BodiesJob, spreads),
    offsetof(BodiesJob, bends),
    sizeof(ContactsJob), offsetof(ContactsJob, pieces), offsetof(ContactsJob, depth), offsetof(ContactsJob, owner),
    offsetof(ContactsJob, height), offsetof(ContactsJob, width), offsetof(ContactsJob, pieces_end),
    offsetof(ContactsJob, near_m), offsetof(ContactsJob, near_relative), offsetof(ContactsJob, before_m),
    offsetof(ContactsJob, before_relative), offsetof(ContactsJob, behind_relative), offsetof(ContactsJob, room),
    offsetof(ContactsJob, pairs), offsetof(ContactsJob, counts),
};
}  // namespace

GGSLAM_EXPORT const std::size_t* ggslam_objects_layout(int* count) {
  *count = static_cast<int>(sizeof(kLayout) / sizeof(kLayout[0]));
  return kLayout;
}
