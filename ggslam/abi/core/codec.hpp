// SPDX-License-Identifier: Apache-2.0
// The compiled core's G-PCC codec (ISO/IEC 23090-9, first edition) and LZF.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/export.hpp"

namespace ggslam::gpcc {

enum Status : int {
  kOk = 0,
  kOutOfMemory = 1,
  kTruncated = 2,      // the payload ends before what it describes, or holds an impossible value
  kCountMismatch = 3,  // it describes another number of points than its unit says
  kTooLarge = 4,       // it describes more than the decoder is willing to hold
};

// What octree geometry coding depends on.
struct OctreeSettings {
  std::int32_t depth;               // levels that are coded; the root has an edge of 2^depth
  std::int32_t neighbour_boundary;  // neighbours are looked up within cubes of 2^this nodes; 0: siblings only
  std::int32_t adjacent_child;
  std::int32_t intra_prediction;    // nodes of an edge below 2^this are predicted from their 26 neighbours
  std::int32_t unique_points;       // 0: the number of points is coded for every leaf
};

// What geometry coding in general depends on: trees whose nodes are not split along every axis (QTBT), planes, points
// that are coded directly, scaled positions, several codewords.
struct TreeSettings {
  std::int32_t levels, neighbour_boundary, adjacent_child, intra_prediction, unique_points;
  std::int32_t direct_mode;   // 0 to 3
  std::int32_t direct_pairs;  // two points share what their positions begin with
  std::int32_t direct_rate;   // of 32 nodes that could be coded directly, with planes in mode 1
  std::int32_t planes, plane_thresholds[3];
  std::int32_t scaling, slice_qp, direct_qp, qp_shift;
  std::int32_t codewords;
  std::int32_t separate_bits;  // bins of equal probability are a stream of their own
  std::uint8_t axes[64];       // by level: 4 x, 2 y, 1 z
};

// What predictive geometry depends on.
struct PredictiveSettings {
  std::int32_t unique_points, scaling, slice_qp, qp_shift;
  std::int32_t qp_interval;  // points that share a quantiser
  std::int32_t residual_bits[3];
  std::int32_t separate_bits;
};

// What an attribute's coding by the region-adaptive hierarchical transform depends on.
struct RahtSettings {
  std::int32_t components;   // 1 or 3
  std::int32_t bit_depth;
  std::int32_t qp, qp_secondary;  // of component 0 and of the others
  std::int32_t prediction;
  std::int32_t min_parent_neighbours, min_neighbours;  // prediction thresholds 0 and 1
  std::int32_t layers, layer_qps[32][2];  // quantisers by level from the root; 0: qp and qp_secondary for all
  std::int32_t separate_bits;  // bins of equal probability are a stream of their own
  std::int32_t index;          // the attribute whose contexts a slice goes on with; negative: none does
  std::int32_t first_version;  // the stream was written by this codec when its roots of large weights were its own
  float rdoq;                // encoder: weight of a bit in dropping coefficients, 1 as the reference's; 0: none is dropped
};

// What an attribute's coding by the predicting and the lifting transform depends on.
struct DetailSettings {
  std::int32_t components, bit_depth, lifting;
  std::int32_t neighbours, search_between, bias[3];
  std::int32_t levels, canonical_order;
  std::int32_t decimation;      // 0 by distance, 1 every n-th point, 2 by octree cubes
  std::int32_t periods[32];     // n of each level, from the finest
  std::int32_t first_distance;  // logarithm of the distance at the finest level
  std::int32_t direct_predictors, direct_threshold, no_average;
  std::int32_t search_within;   // how many points of its own level a point may be predicted from...
  std::int32_t skip_layers;     // ...but not at so many of the finest levels
  std::int32_t blend;
  std::int32_t weighted;        // components take over parts of others, in quarters, by level from the coarsest
  std::int32_t component_weights[32][2];
  std::int32_t layers, layer_qps[32][2];  // quantisers by level from the coarsest
  std::int32_t separate_bits, index;      // as in RahtSettings
};

// clip(floor(scale p + rounding), first, last) - first.
struct Grid {
  double scale, rounding;
  std::int64_t first[3], last[3];
  std::int32_t exact;  // coordinates are integers and stand for themselves
};

// Points [*, 3] of which `rows` [count] are meant; without rows, the first `count`.
struct Points {
  const void* data;
  const std::int64_t* rows;
  std::size_t count;
  std::int32_t kind;  // 0: int32, 1: int64, 2: float, 3: double
};

}  // namespace ggslam::gpcc

GGSLAM_EXPORT void* ggslam_gpcc_slice_create();
GGSLAM_EXPORT int ggslam_gpcc_slice_destroy(void* slice);

// Builds the octree of points [count, 3] in [0, 2^depth). `order` [count] receives their coding order.
GGSLAM_EXPORT std::int64_t ggslam_gpcc_build(void* context, void* slice, const std::int32_t* points,
                                             std::uint32_t count, std::int32_t depth, std::uint32_t* order);
GGSLAM_EXPORT std::uint32_t ggslam_gpcc_leaves(void* slice);

// Number of nodes at a level below the tree's depth.
GGSLAM_EXPORT std::uint32_t ggslam_gpcc_nodes(void* slice, std::int32_t level);

// Number of points in each leaf, `counts` [leaves].
GGSLAM_EXPORT int ggslam_gpcc_leaf_points(void* slice, std::uint32_t* counts);

// Makes every leaf one point.
GGSLAM_EXPORT std::int64_t ggslam_gpcc_merge(void* slice);

// Returns the number of bytes, which ggslam_gpcc_take copies.
GGSLAM_EXPORT std::int64_t ggslam_gpcc_encode_geometry(void* context, void* slice,
                                                       const ggslam::gpcc::OctreeSettings* settings);

// `attributes` [points, components] in coding order; replaced by what a decoder will reconstruct. Returns the number of
// bytes.
GGSLAM_EXPORT std::int64_t ggslam_gpcc_encode_attribute(void* context, void* slice,
                                                        const ggslam::gpcc::RahtSettings* settings,
                                                        std::int32_t* attributes);
GGSLAM_EXPORT int ggslam_gpcc_take(void* slice, std::uint8_t* out);

// Decodes a geometry payload that is said to hold `points` points.
GGSLAM_EXPORT std::int64_t ggslam_gpcc_decode_geometry(void* context, void* slice,
                                                       const ggslam::gpcc::OctreeSettings* settings,
                                                       const std::uint8_t* data, std::size_t size,
                                                       std::uint32_t points);

// The same where the tree does not split every node along all axes, or has other tools than an octree. Its root lies in
// [0, 2^depth)^3.
GGSLAM_EXPORT std::int64_t ggslam_gpcc_decode_tree(void* context, void* slice,
                                                   const ggslam::gpcc::TreeSettings* settings, std::int32_t depth,
                                                   const std::uint8_t* data, std::size_t size, std::uint32_t points);

// The same by predictive geometry.
GGSLAM_EXPORT std::int64_t ggslam_gpcc_decode_predictive(void* context, void* slice,
                                                         const ggslam::gpcc::PredictiveSettings* settings,
                                                         std::int32_t depth, const std::uint8_t* data, std::size_t size,
                                                         std::uint32_t points);

// Codes the slice's points by such a tree. Returns the number of bytes.
GGSLAM_EXPORT std::int64_t ggslam_gpcc_encode_tree(void* context, void* slice,
                                                   const ggslam::gpcc::TreeSettings* settings);

// Hands on the contexts of the slice before, for slices that go on with them.
GGSLAM_EXPORT std::int64_t ggslam_gpcc_go_on(void* slice, const void* before);

// Positions [points, 3] in coding order.
GGSLAM_EXPORT std::int64_t ggslam_gpcc_positions(void* context, void* slice, std::int32_t* out);
GGSLAM_EXPORT std::int64_t ggslam_gpcc_decode_attribute(void* context, void* slice,
                                                        const ggslam::gpcc::RahtSettings* settings,
                                                        const std::uint8_t* data, std::size_t size,
                                                        std::int32_t* attributes);

// The same by the predicting or the lifting transform.
GGSLAM_EXPORT std::int64_t ggslam_gpcc_decode_details(void* context, void* slice,
                                                      const ggslam::gpcc::DetailSettings* settings,
                                                      const std::uint8_t* data, std::size_t size,
                                                      std::int32_t* attributes);

// Brings values [points, components] from the order of the stream, in which raw attributes are, into coding order.
GGSLAM_EXPORT std::int64_t ggslam_gpcc_sort_values(void* slice, std::int32_t components, std::int32_t* values);

// Y, Cb, Cr [count, 3] of the colours rgb[order[i]], rgb [colors, 3].
GGSLAM_EXPORT int ggslam_gpcc_to_ycbcr(void* context, const std::uint8_t* rgb, std::uint32_t colors,
                                       const std::uint32_t* order, std::uint32_t count, std::int32_t* out);
GGSLAM_EXPORT int ggslam_gpcc_from_ycbcr(void* context, const std::int32_t* components, std::uint32_t count,
                                         std::uint8_t* rgb);

// Grid positions [count, 3].
GGSLAM_EXPORT int ggslam_gpcc_on_grid(const ggslam::gpcc::Points* points, const ggslam::gpcc::Grid* grid,
                                      std::int32_t* out);

// Grid coordinates [count] along one axis.
GGSLAM_EXPORT int ggslam_gpcc_along_axis(const ggslam::gpcc::Points* points, const ggslam::gpcc::Grid* grid,
                                         std::int32_t axis, std::int32_t* out);

// Adds to counts [planes] the number of points in each plane across an axis.
GGSLAM_EXPORT int ggslam_gpcc_plane_counts(const ggslam::gpcc::Points* points, const ggslam::gpcc::Grid* grid,
                                           std::int32_t axis, std::uint32_t* counts);

// numbers [count] become number_of_plane[coordinate]. The indices of points in planes that are marked as cut are appended
// to `inside`, which has room for them.
GGSLAM_EXPORT int ggslam_gpcc_number_planes(const ggslam::gpcc::Points* points, const ggslam::gpcc::Grid* grid,
                                            std::int32_t axis, const std::uint16_t* number_of_plane,
                                            const std::uint8_t* cut, std::uint16_t* numbers, std::int64_t* inside);

// Appends to `codes`, which has room for count of them, the points in cubes of an edge of 2^cube_bits voxels that a hash
// chooses: one slab across x in slab_mask + 1, and of its cubes one in cube_mask + 1 (powers of two). Most points are
// passed over by one coordinate. A code has 21 bits a coordinate. Returns how many there are.
GGSLAM_EXPORT std::int64_t ggslam_gpcc_sample_cubes(const ggslam::gpcc::Points* points, const ggslam::gpcc::Grid* grid,
                                                    std::int32_t cube_bits, std::uint32_t slab_mask,
                                                    std::uint32_t cube_mask, std::uint64_t* codes);

// Bytes written to `out`, which must hold size + size / 32 + 1, or kNoRoom.
GGSLAM_EXPORT int64_t ggslam_lzf_compress(const uint8_t* data, int64_t size, uint8_t* out, int64_t capacity);

// 0 when `data` stand for exactly `size` bytes, which are then in `out`; else one of Failure.
GGSLAM_EXPORT int64_t ggslam_lzf_decompress(const uint8_t* data, int64_t packed, uint8_t* out, int64_t size);
