// SPDX-License-Identifier: Apache-2.0
// What the entry points and the kernels of the G-PCC codec (ISO/IEC 23090-9, first edition) share.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

#include "common/dispatch.hpp"

namespace ggslam::gpcc {

enum Status : int {
  kOk = 0,
  kOutOfMemory = 1,
  kTruncated = 2,      // the payload ends before what it describes, or holds an impossible value
  kCountMismatch = 3,  // it describes another number of points than its unit says
  kTooLarge = 4,       // it describes more than the decoder is willing to hold
};

// A decoder holds no more than this; slices within the level limit of 1.1 million points need less.
inline constexpr std::uint64_t kMaxNodes = 24u << 20;  // of all levels together
inline constexpr std::int64_t kMaxPosition = 1 << 21;  // in a slice
inline constexpr std::uint32_t kMaxLinked = 2u << 20;  // nodes of one level that have neighbours

// What octree geometry coding depends on. Mirrored in ggslam/coding/native.py.
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

// The nodes of one size in Morton order. Entry 0 of each array stands for "no node"; nodes count from 1.
struct Level {
  std::vector<std::uint8_t> occupancy;
  std::vector<std::uint32_t> first_child;  // index of the first child in the next level (or of the first leaf)
  std::vector<std::uint32_t> weight;       // points below

  std::uint32_t size() const { return static_cast<std::uint32_t>(occupancy.size()) - 1; }
};

// levels[0] is the root, levels[depth - 1] holds the parents of the leaves.
struct Octree {
  std::vector<Level> levels;
  std::vector<std::uint32_t> leaf_points;  // from entry 1; empty if every leaf is one point
  std::uint32_t leaves = 0;
  std::uint64_t points = 0;

  int depth() const { return static_cast<int>(levels.size()); }
  std::uint32_t weight_of_leaf(std::uint32_t leaf) const { return leaf_points.empty() ? 1 : leaf_points[leaf]; }
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

// Adaptive contexts that a slice leaves to the next one, as bytes; empty: none.
struct Memory {
  std::vector<std::uint8_t> bytes;

  template <class Contexts>
  void load(Contexts& contexts) const {
    if (bytes.size() == sizeof(Contexts)) std::memcpy(static_cast<void*>(&contexts), bytes.data(), sizeof(Contexts));
  }
  template <class Contexts>
  void save(const Contexts& contexts) {
    const auto* begin = reinterpret_cast<const std::uint8_t*>(&contexts);
    bytes.assign(begin, begin + sizeof(Contexts));
  }
};

// Counts the points below every node; needed by the attribute coder.
void sum_weights(Octree& tree);

}  // namespace ggslam::gpcc
