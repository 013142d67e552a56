// SPDX-License-Identifier: Apache-2.0
// What is asked of a map.
#pragma once
#include "common/context.hpp"
#include "volumes/occupancy_tree.hpp"

namespace ggslam {

constexpr std::int8_t kStateUnknown = -1, kStateFree = 0, kStateOccupied = 1;

// State and log-odds (NaN: unknown) of the voxels that n points lie in; either output may be null.
void look_up(Context& context, const OccupancyTree& tree, const float* points, std::size_t n, float threshold,
             std::int8_t* states, float* log_odds);

struct OccupancyLeaf {
  float centre[3], size, log_odds;
};

// The pruned leaves; which: 0 all, 1 the occupied ones, 2 the free ones.
std::vector<OccupancyLeaf> list_leaves(const OccupancyTree& tree, float threshold, int which);

struct OccupancySummary {
  std::uint64_t occupied, free;  // voxels of the finest level
  std::uint64_t blocks, nodes, bytes;
  std::int32_t known_low[3], known_high[3];        // keys of the box around all known voxels, both ends included
  std::int32_t occupied_low[3], occupied_high[3];  // likewise the occupied ones; low > high where there are none
};

OccupancySummary summarize(const OccupancyTree& tree, float threshold);

// counts[3 i + j]: how many voxels are in state i (0 unknown, 1 free, 2 occupied) in one map and in j in the other.
void count_states(const OccupancyTree& one, const OccupancyTree& other, float threshold_one, float threshold_other,
                  std::uint64_t counts[9]);

}  // namespace ggslam
