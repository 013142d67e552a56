// SPDX-License-Identifier: Apache-2.0
// Plain structures that the distance field shares with its kernels. Lengths are in voxels unless said otherwise.
#pragma once
#include <cstddef>
#include <cstdint>

#include "native/formulas/site_rules.hpp"
#include "volumes/tsdf.hpp"

namespace ggslam::volumes {

// Half the diagonal of a block: from its middle to the centres of its corner voxels.
constexpr float kBlockReach = 6.0622f;
// Voxels of a part of a block along an edge, and half the diagonal of a part.
constexpr int kPart = 4;
constexpr float kPartReach = 2.5981f;

// The surface within a voxel: a disc. The field is the distance to the nearest of all discs.
struct Site {
  float at[3];      // its middle, from the centre of the block's first voxel
  float normal[3];  // unit vector to the side in front; zero: unknown, and a point rather than a disc
  float radius;
  int32_t voxel;    // its row in the block
};

// A disc of some thickness with sites in it: what is farther from it than a distance is farther from all of them.
struct Node {
  float middle[3];  // as Site.at
  float normal[3];
  float radius, half;  // half the thickness
  float within[3];  // the middle of one of the sites
};

// Sites of a block: those from the end of the last leaf to the end of this.
struct Leaf {
  Node node;
  int32_t end;
};

constexpr int kSiteColumns = 7;  // at, normal, radius

// A leaf as a search reads it.
struct SiteGroup {
  const Node* node;
  const Site* sites;
  const float* columns;  // of the sites, `stride` apart, with room for a full vector behind the last
  std::size_t stride;
  int32_t count;
  BlockCoordinates at;   // of their block
  uint32_t first;        // its voxel 0 among owners
};

// Nodes as columns, from the centre of the first voxel of one block, or each of its own; with room for a full vector behind
// them.
struct NodeColumns {
  static constexpr int kColumns = 11;  // as Node
  const float* first;
  std::size_t stride;
  int count;
  const int32_t* at[3];  // blocks of the nodes, if their places are counted from those
  BlockCoordinates origin;  // then: of the block from whose first voxel places in question are counted
  const float* column(int c) const { return first + c * stride; }
};

// Whose distance a voxel has: voxel of a block's slot, 512 slot + row.
constexpr uint32_t kNobody = 0xffffffffu;

// Distances and gradients of a block. NaN: unknown.
struct FieldVoxels {
  float distance[kVoxels];     // metres, negative behind the surface
  uint32_t gradient[kVoxels];  // 10 bits for each of x, y, z: 511 (1 + component)
  uint32_t owner[kVoxels];     // of the nearest site; kNobody: none is near enough
};

// The sites of a block, in the order of their voxels.
struct SiteList {
  const Site* sites;
  int32_t count;
  BlockCoordinates at;
};

// A site that came when there was no time for a block.
struct MissedSite {
  const Site* site;
  BlockCoordinates at;  // of its block
  uint32_t owner;
};

// A block to bring up to date.
struct NearestInput {
  BlockCoordinates at;
  NodeColumns all, arrived;      // of groups of all sites, of those that came or moved: what may be near enough
  const int32_t *all_numbers, *arrived_numbers;  // of the groups in the columns
  const SiteGroup *groups, *arrivals;  // by number
  const MissedSite* missed;      // that came before
  int32_t missed_count;
  const SiteList* slots;         // of the owners that voxels have
  const uint64_t *known, *negative;
  const uint64_t *search;        // voxels whose nearest site may be any
  const uint64_t* orphans;       // those of them whose site moved or went: no site that stayed is nearer than it was
  const uint64_t* redo;          // voxels to be measured again from the site they have
  float voxel;                   // metres
  float max_distance;
  float slack;                   // for roundings
};

struct NearestOutput {
  float farthest;  // the largest distance of a known voxel, not its sign
  int32_t computed;  // voxels that were
};

struct QueryInput {
  TableView table;
  const FieldVoxels* const* voxels;  // by row
  const uint8_t* stale;              // by row
  float voxel;
  const double* points;  // [n, 3], metres
};

}  // namespace ggslam::volumes
