// SPDX-License-Identifier: Apache-2.0
// The compiled core's planner: paths of a ball through cells that know how far the nearest obstacle is.
#pragma once
#include <cstdint>

#include "abi/export.hpp"

namespace ggslam::driving {

// A way to look for. Metres from the grid's origin; in grids of two dimensions z counts for nothing.
struct WayQuery {
  double start[3], goal[3];
  float radius;    // least clearance
  float margin;    // clearance beyond the radius from which on a metre costs a metre
  float weight;    // what a metre costs more at the radius, falling with the square of what is left of the margin
  int32_t widest;  // the way with the largest least clearance, whatever its length; radius: what may still be entered
};

// How a search stands: kSearching (go on), kNeedsPages, kFound, kNoWay.
enum SearchState : int { kSearching, kNeedsPages, kFound, kNoWay };

struct WayStats {
  int64_t expanded;   // cells whose neighbours were looked at
  int64_t points;     // of the way
  double cost;        // of the way, metres; widest: its least clearance
  double reached[3];  // cell that was reached nearest to the goal
  int32_t wanted[3];  // page that is needed
};

// How a path is pulled tight and smoothed. Lengths in metres.
struct SmoothingSettings {
  float radius, margin, weight;  // as of the search
  float spacing;                 // between the points of the result
  float push;                    // part of a point's missing margin that it is pushed away in a pass
  float most_length;             // longer than this it does not get
  int32_t passes;                // 0: it is pulled tight only
};

}  // namespace ggslam::driving

// A grid of cells with edges of `cell` metres in 2 or 3 dimensions; where `page` is not 0, it is read page by page, of
// page^dimensions blocks (of 32^2 or 8^3 cells).
GGSLAM_EXPORT void* ggslam_way_grid_create(int dimensions, double cell, int page);
GGSLAM_EXPORT int ggslam_way_grid_destroy(void* grid);
GGSLAM_EXPORT int64_t ggslam_way_grid_bytes(void* grid);

// Clearances [shape z, y, x] in metres of the cells from `low` on; NaN: may not be entered. `lower`: none becomes larger
// that a search has met.
GGSLAM_EXPORT int ggslam_way_grid_write(void* grid, const int32_t* low, const int32_t* shape, const float* clearance,
                                        int lower);
GGSLAM_EXPORT int ggslam_way_grid_read(void* grid, const int32_t* low, const int32_t* shape, float* clearance);

// What is not written in a page by now has nothing that may be entered.
GGSLAM_EXPORT int ggslam_way_grid_finish_page(void* grid, const int32_t* page);

// Interpolated clearances [n] and their gradients [n, 3] (may be null) at points [n, 3]; NaN: beside a cell that may not
// be entered.
GGSLAM_EXPORT int ggslam_way_grid_query(void* grid, int64_t n, const double* points, float* clearance, float* gradient);

// Least clearances [n - 1] along the pieces of a path through points [n, 3].
GGSLAM_EXPORT int ggslam_way_grid_least(void* grid, int64_t n, const double* points, float* least);

// Begins a search, and goes on with it for so many cells; returns a SearchState.
GGSLAM_EXPORT int ggslam_way_begin(void* grid, const ggslam::driving::WayQuery* query);
GGSLAM_EXPORT int ggslam_way_search(void* grid, int64_t most, ggslam::driving::WayStats* stats);

// Points [stats.points, 3] of the way that was found, metres.
GGSLAM_EXPORT int ggslam_way_points(void* grid, int64_t n, double* points);

// Pulls a path tight and smooths it; returns the number of points, which `ggslam_way_smooth_points` copies.
GGSLAM_EXPORT int64_t ggslam_way_smooth(void* grid, int64_t n, const double* points,
                                        const ggslam::driving::SmoothingSettings* settings);
GGSLAM_EXPORT int ggslam_way_smooth_points(void* grid, int64_t n, double* points);

// Distances [shape z, y, x] in metres from cells' centres to the nearest occupied cell of a box, `reach` cells and more
// as that much.
GGSLAM_EXPORT int ggslam_cell_distances(void* context, const int32_t* shape, const uint8_t* occupied, float cell,
                                        int reach, float* distance);
