// SPDX-License-Identifier: Apache-2.0
// The data sections of OctoMap's files: ".bt" (free or occupied, two bits a child) and ".ot" (log-odds).
#pragma once
#include <cstdint>
#include <string>
#include <vector>

#include "volumes/occupancy_tree.hpp"

namespace ggslam {

enum class OctomapFormat : int { binary = 0, full = 1 };

enum class OctomapFault : int {
  none = 0,
  cut_off = 1,     // the data end within the tree
  too_deep = 2,    // a voxel has children
  childless = 3,   // an inner node without children
  not_finite = 4,  // a leaf's value is no number
  too_large = 5,   // more blocks than allowed
};

struct OctomapText {
  std::vector<std::uint8_t> data;
  std::uint64_t nodes = 0;  // inner ones and leaves
};

OctomapText write_octomap(const OccupancyTree& tree, OctomapFormat format, float threshold);

struct OctomapReading {
  OctomapFault fault = OctomapFault::none;
  std::uint64_t nodes = 0, bytes_used = 0;
};

// Leaves of a binary file get the values `free` and `occupied`. The tree is emptied first, and again after a fault.
OctomapReading read_octomap(OccupancyTree& tree, OctomapFormat format, const std::uint8_t* data, std::size_t size,
                            float free, float occupied, std::uint64_t maximum_blocks);

}  // namespace ggslam
