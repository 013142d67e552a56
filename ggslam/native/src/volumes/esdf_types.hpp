// SPDX-License-Identifier: Apache-2.0
// Plain structures that the distance field shares with its kernels. Lengths are in voxels unless said otherwise.
#pragma once
#include <cstddef>
#include <cstdint>

#include "volumes/tsdf.hpp"

namespace ggslam::volumes {

constexpr int kHalo = kSide + 2;         // side of a block with one voxel around it
constexpr int16_t kUnseen = -32768;      // among values of the TSDF

// Largest distance of a site's point from its voxel's centre: a mean of crossings, each within half an edge.
constexpr float kSiteOffset = 0.5f;
// Around its point, as far as this, the surface of a site is taken to be its tangent disc.
constexpr float kDiscRadius = 0.9f;
// The result of a voxel whose nearest site is d away depends on sites up to d + kReading away (voxel centres): the
// search ends at points within d + kSiteOffset, whose centres are kSiteOffset farther, whose neighbours sqrt(3).
constexpr float kReading = 2 * kSiteOffset + 1.7321f;
// The distance of the nearest site's centre is larger than the field's distance by this at most.
constexpr float kCentreSlack = kSiteOffset + kDiscRadius;

// The surface within a voxel: a point of it and its normal there.
struct Site {
  float point[3];   // from the voxel's centre
  float normal[3];  // unit vector to the side in front; zero: unknown
  int32_t voxel;    // its row in the block
};

// A voxel of a box.
struct SiteCell {
  int16_t x, y, z;
};

// A site in a box. Positions are differences of whole voxels plus `point`, so that results do not depend on the box.
struct BoxSite {
  SiteCell cell;
  int16_t neighbour_count;
  int32_t neighbours;  // where its list of neighbours begins
  float point[3], normal[3];
};

// Distances and gradients of a block. NaN: unknown.
struct FieldVoxels {
  float distance[kVoxels];     // metres, negative behind the surface
  uint32_t gradient[kVoxels];  // 10 bits for each of x, y, z: 511 (1 + component)
};

// Lines of voxels along one axis of a box, x by x; see esdf_envelopes.
struct EnvelopeLines {
  const int32_t* in;         // nearest sites so far: in[position * in_stride + x]; -1: none
  std::size_t in_stride;
  const int32_t* positions;  // on the line where there may be sites, ascending
  int count;
  int32_t* out;              // out[(position - first) * out_stride + x]; may be `in`
  std::size_t out_stride;
  int first, last;           // positions to write, half-open
  int x, columns;            // lines at x ... x + columns - 1
  int y;                     // of the lines, where they run along z
  const SiteCell* cells;
  int limit;                 // sites farther than the root of this are dropped
};

// A block whose nearest sites are known.
struct RefineInput {
  const BoxSite* sites;
  const SiteCell* cells;
  const int32_t* neighbours;
  const int32_t* nearest;    // of voxel (0, 0, 0); -1: none
  std::size_t stride_y, stride_z;
  int origin[3];             // of the block in the box
  const uint64_t *known, *negative;
  int low[3], high[3];       // sites outside of these voxels are not in the box; half-open
  float voxel;               // metres
  float max_distance;
};

struct RefineOutput {
  float required;  // how far around the block sites must be known, as far as can be told
  float missing;   // how much farther they should have been known; valid if not positive
};

struct QueryInput {
  TableView table;
  const FieldVoxels* const* voxels;  // by row
  float voxel;
  const double* points;  // [n, 3], metres
};

}  // namespace ggslam::volumes
