// SPDX-License-Identifier: Apache-2.0
// Written by scripts/tools/make_native_mirrors.py from codec.hpp; changes are lost. Size of each structure and
// offsets of its fields, in the order of the header, so that a caller can check its mirrors of them.
#include <cstddef>
#include <cstdint>

#include "interface/core/codec.hpp"

using ggslam::gpcc::DetailSettings;
using ggslam::gpcc::Grid;
using ggslam::gpcc::OctreeSettings;
using ggslam::gpcc::Points;
using ggslam::gpcc::PredictiveSettings;
using ggslam::gpcc::RahtSettings;
using ggslam::gpcc::TreeSettings;

namespace {
constexpr std::size_t kLayout[] = {
    sizeof(OctreeSettings), offsetof(OctreeSettings, depth), offsetof(OctreeSettings, neighbour_boundary),
    offsetof(OctreeSettings, adjacent_child), offsetof(OctreeSettings, intra_prediction),
    offsetof(OctreeSettings, unique_points),
    sizeof(TreeSettings), offsetof(TreeSettings, levels), offsetof(TreeSettings, neighbour_boundary),
    offsetof(TreeSettings, adjacent_child), offsetof(TreeSettings, intra_prediction),
    offsetof(TreeSettings, unique_points), offsetof(TreeSettings, direct_mode), offsetof(TreeSettings, direct_pairs),
    offsetof(TreeSettings, direct_rate), offsetof(TreeSettings, planes), offsetof(TreeSettings, plane_thresholds),
    offsetof(TreeSettings, scaling), offsetof(TreeSettings, slice_qp), offsetof(TreeSettings, direct_qp),
    offsetof(TreeSettings, qp_shift), offsetof(TreeSettings, codewords), offsetof(TreeSettings, separate_bits),
    offsetof(TreeSettings, axes),
    sizeof(PredictiveSettings), offsetof(PredictiveSettings, unique_points), offsetof(PredictiveSettings, scaling),
    offsetof(PredictiveSettings, slice_qp), offsetof(PredictiveSettings, qp_shift),
    offsetof(PredictiveSettings, qp_interval), offsetof(PredictiveSettings, residual_bits),
    offsetof(PredictiveSettings, separate_bits),
    sizeof(RahtSettings), offsetof(RahtSettings, components), offsetof(RahtSettings, bit_depth),
    offsetof(RahtSettings, qp), offsetof(RahtSettings, qp_secondary), offsetof(RahtSettings, prediction),
    offsetof(RahtSettings, min_parent_neighbours), offsetof(RahtSettings, min_neighbours),
    offsetof(RahtSettings, layers), offsetof(RahtSettings, layer_qps), offsetof(RahtSettings, separate_bits),
    offsetof(RahtSettings, index), offsetof(RahtSettings, first_version), offsetof(RahtSettings, rdoq),
    sizeof(DetailSettings), offsetof(DetailSettings, components), offsetof(DetailSettings, bit_depth),
    offsetof(DetailSettings, lifting), offsetof(DetailSettings, neighbours), offsetof(DetailSettings, search_between),
    offsetof(DetailSettings, bias), offsetof(DetailSettings, levels), offsetof(DetailSettings, canonical_order),
    offsetof(DetailSettings, decimation), offsetof(DetailSettings, periods), offsetof(DetailSettings, first_distance),
    offsetof(DetailSettings, direct_predictors), offsetof(DetailSettings, direct_threshold),
    offsetof(DetailSettings, no_average), offsetof(DetailSettings, search_within),
    offsetof(DetailSettings, skip_layers), offsetof(DetailSettings, blend), offsetof(DetailSettings, weighted),
    offsetof(DetailSettings, component_weights), offsetof(DetailSettings, layers), offsetof(DetailSettings, layer_qps),
    offsetof(DetailSettings, separate_bits), offsetof(DetailSettings, index),
    sizeof(Grid), offsetof(Grid, scale), offsetof(Grid, rounding), offsetof(Grid, first), offsetof(Grid, last),
    offsetof(Grid, exact),
    sizeof(Points), offsetof(Points, data), offsetof(Points, rows), offsetof(Points, count), offsetof(Points, kind),
};
}  // namespace

GGSLAM_EXPORT const std::size_t* ggslam_codec_layout(int* count) {
  *count = static_cast<int>(sizeof(kLayout) / sizeof(kLayout[0]));
  return kLayout;
}
