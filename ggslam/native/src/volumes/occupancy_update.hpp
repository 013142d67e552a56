// SPDX-License-Identifier: Apache-2.0
// One scan's hits and misses applied to a map.
#pragma once
#include "volumes/occupancy_tree.hpp"
#include "volumes/scan_rays.hpp"

namespace ggslam {

// Log-odds (Hornung et al., "OctoMap", 2013, equations 2 and 4).
struct OccupancyUpdate {
  float hit, miss, minimum, maximum;
  std::int32_t most_hits = 1;  // hits of a voxel in one scan: as many as it has points, at most so many
};

void apply_scan(Context& context, const Scan& scan, const OccupancyUpdate& update, OccupancyTree& tree);

}  // namespace ggslam
