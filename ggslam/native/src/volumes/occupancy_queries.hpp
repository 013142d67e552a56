// SPDX-License-Identifier: Apache-2.0
// What is asked of a map.
#pragma once
#include "common/context.hpp"
#include "abi/core/volumes.hpp"
#include "volumes/occupancy_tree.hpp"

namespace ggslam {

constexpr std::int8_t kStateUnknown = -1, kStateFree = 0, kStateOccupied = 1;

// State and log-odds (NaN: unknown) of the voxels that n points lie in; either output may be null.
void look_up(Context& context, const OccupancyTree& tree, const float* points, std::size_t n, float threshold,
             std::int8_t* states, float* log_odds);

// The pruned leaves; which: 0 all, 1 the occupied ones, 2 the free ones.
std::vector<OccupancyLeaf> list_leaves(const OccupancyTree& tree, float threshold, int which);

OccupancySummary summarize(const OccupancyTree& tree, float threshold);

// counts[3 i + j]: how many voxels are in state i (0 unknown, 1 free, 2 occupied) in one map and in j in the other.
void count_states(const OccupancyTree& one, const OccupancyTree& other, float threshold_one, float threshold_other,
                  std::uint64_t counts[9]);

}  // namespace ggslam
