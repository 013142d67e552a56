// SPDX-License-Identifier: Apache-2.0
// The compiled core's passes over the pixels of a depth image that falls into segments.
#pragma once
#include <cstdint>

#include "abi/export.hpp"

namespace ggslam {

// A depth image prepared for segmentation, [H, W] with H = height, W = width. A gap of more than gap_m + gap_sigmas *
// sigma * depth^2 metres separates surfaces.
struct SegmentedSurface {
  const uint8_t* valid;  // not 0 where there is depth
  const float* depth;    // metres
  const float* inverse;  // 1 / depth
  const float* points;   // [H, W, 3], metres, camera frame
  const float* normals;  // [H, W, 3], unit, towards the camera
  int32_t height, width;
  int32_t step;  // pixels over which the normals were taken
  float sigma;   // noise of inverse depth, 1/m
  float gap_m, gap_sigmas;
};

// Links between a pixel and its right neighbour, [H, W - 1], and its lower one, [H - 1, W]; 0 or 1.
struct PixelLinks {
  uint8_t* right;
  uint8_t* below;
};

// Normals from differences of inverse depth over `step` pixels, on one side only where the other is beyond a jump.
struct NormalsJob {
  const float* inverse;  // [H, W], 1/m
  const float* rays;     // [H, W, 3], of the camera, z = 1
  int32_t height, width, step;
  float fx, fy;  // pixels
  float jump;    // 1/m
  float* normals;  // [H, W, 3], result: unit, towards the camera
};

// How many colours are like the mean one of a piece, outside of the piece.
struct AlikeColorsJob {
  const float* colors;    // [pixels, 3]
  const int32_t* pieces;  // [pixels], piece of each
  int64_t pixels;
  const int32_t* asked;  // [count], pieces
  const float* means;    // [count, 3], their mean colours
  int64_t count;
  float limit;      // distance of colours that are alike
  int64_t* alike;   // [count], result
};

// Which colours of a plane occur in few places of it.
struct OutlierColorsJob {
  const float* lab;       // [H, W, 3], CIELAB, each channel 0 to 255
  const uint8_t* inside;  // [H, W], not 0: the plane
  const int32_t* pieces;  // [H, W], from 0 to `pieces_end`, between which colours change abruptly
  int32_t height, width, pieces_end;
  double light[3];  // L of the plane is light[0] * row + light[1] * column + light[2]
  float bins[3];    // width of bins of L, relative to that, and of a and b
  int32_t cell;     // pixels along a cell of the image
  double least_cell;  // pixels of the plane in a cell that counts
  double occurs;      // share of a cell's pixels from which a colour occurs in it
  double usual;       // share of the cells in which the plane's own colours occur
  double base;        // a piece that is so much of the plane is the plane
  double same_hue;    // difference of hue below which a colour may be one of the plane's in another light
  double darkest, brightest;  // ...between these ratios of L
  uint8_t* kind;              // [H, W], result: 0, or 1 where colours are strange, 2 where no light explains it
};

// Where surfaces go on from pixel to pixel.
struct SurfaceLinksJob {
  SegmentedSurface surface;
  const uint8_t* rest;   // [H, W], not 0: pixels that may be linked smoothly
  double least_cosine;   // between normals; less is an edge
  PixelLinks closed;     // result: no gap in between
  PixelLinks smooth;     // result: of the rest, and no concave edge either
};

// Pieces of pixels that hang together.
struct PiecesJob {
  const int32_t* ids;  // [H, W]: neighbours of one id are linked; may be null, then `links` says which
  PixelLinks links;
  int32_t height, width;
  int32_t* pieces;  // [H, W], result: from 1 on in raster order
};

// Regions [H, W] that grow over pixels without region, one pixel a pass, where a link leads.
struct GrowthJob {
  int32_t* regions;      // changed in place; 0 = none
  const uint8_t* valid;  // [H, W], not 0: may be grown over
  PixelLinks links;
  int32_t height, width, passes;
};

// The nearest of some planes 1 / z = w . ray that a pixel lies on and has the normal of.
struct PlaneClaimJob {
  SegmentedSurface surface;
  const float* rays_x;   // [W], x / z of each column
  const float* rays_y;   // [H], y / z of each row
  const float* planes;   // [count, 3], w
  int32_t count;
  float tolerance, tolerance_m;  // 1/m off a plane at most: tolerance + tolerance_m / depth^2
  double least_cosine;           // between the normals of pixel and plane
  int32_t* label;                // [H, W], result: number of the plane from 1 on, 0 = none
};

// What lies between touching regions.
struct BordersJob {
  SegmentedSurface surface;
  const int32_t* plane_of;     // [H, W], number of the plane from 1 to `planes`, 0 = none
  const float* plane_normals;  // [planes, 3], unit, towards the camera: they count where planes are known
  int32_t planes;
  const float* colors;     // [H, W, 3]
  const int32_t* regions;  // [H, W], below `regions_end`; 0 = none
  int32_t regions_end, reach;
  double least_cosine;
  int64_t room;  // pairs that there is room for
  // Results, a row a pair, pairs ascending: both numbers; links, those closed, judged, concave and bent; median
  // difference of colour.
  int64_t* pairs;
  int64_t* counts;
  double* contrast;
};

// How near the points of a region are to a plane.
struct RegionOnPlane {
  int32_t region;
  float plane[3];   // n / d of the plane n . x = d
  int64_t points;   // result: of the region
  int64_t near_by;  // result: of these, nearer than the limit
};

// Regions that are asked how near to planes they are; one may be asked about several.
struct RegionsOnPlanesJob {
  const float* points;     // [pixels, 3]
  const int32_t* regions;  // [pixels], below `regions_end`
  int64_t pixels;
  int32_t regions_end;
  float limit_m;
  RegionOnPlane* asked;
  int64_t count;
};

// Places and directions of regions, a row a region; region 0 is left out.
struct BodiesJob {
  const float* points;     // [pixels, 3]
  const float* normals;    // [pixels, 3]
  const int32_t* regions;  // [pixels], below `regions_end`
  int64_t pixels;
  int32_t regions_end;
  // Results: number of pixels, mean point [3], mean square distance from it, mean square difference from the mean
  // normal, mean product of both differences.
  int64_t* counts;
  double* centres;
  double* squares;
  double* spreads;
  double* bends;
};

// What other regions lie around the pieces of an image, a row a pair of a piece and the region (`owner`) of a neighbour.
struct ContactsJob {
  const int32_t* pieces;  // [H, W], below `pieces_end`
  const float* depth;     // [H, W], metres
  const int32_t* owner;   // [pieces_end], region of each
  int32_t height, width, pieces_end;
  float near_m, near_relative;  // steps below near_m + near_relative * depth are small
  float before_m, before_relative;  // the neighbour is far before the piece from such a step on
  float behind_relative;        // the piece is not before its neighbour unless by more than this share of the depth
  int64_t room;                 // rows that there is room for
  // Results: piece and region, ascending; links, those with a small step, those where the piece is not before the
  // neighbour, those where the neighbour is far before it.
  int64_t* pairs;
  int64_t* counts;
};

// A mask [H, W] without its dots and slivers: pieces of equal id that are small or nowhere three pixels wide, 0 an id like
// others, are filled with the nearest id, first the small ones.
struct CleaningJob {
  const uint16_t* segments;
  int32_t height, width;
  double smallest;    // pixels of a piece that is not small
  uint16_t* cleaned;  // [H, W], result
};

// Where a mask [H, W] has bled over a jump of depth: near its segment's border a pixel is not trusted that continues the
// inside of another segment, and not that of its own.
struct TrustJob {
  const uint16_t* segments;  // 0 = unlabelled
  const float* depth;        // metres, 0 = unknown
  int32_t height, width;
  int32_t reach;               // pixels from a border that are judged
  float jump_m, jump_relative;  // depths differ from jump_m or jump_relative * depth on, whichever is larger
  uint8_t* trusted;            // [H, W], result: 0 or 1
};

// What the segments of a keyframe share with the objects that a map shows there. They are numbered in the order of their
// ids, without 0.
struct OverlapJob {
  const uint16_t* segments;  // [H, W]
  const uint16_t* ids;       // [H, W], objects that the map shows, 0 = none
  const uint16_t* renamed;   // [65536], what each is called
  const float* confidence;   // [H, W], of that
  const float* shown_depth;  // [H, W], of the map, metres, 0 = nothing
  const float* depth;        // [H, W], measured, 0 = unknown: there the map is believed
  int32_t height, width;
  float tolerance_m, tolerance_relative;  // between both depths, the larger counts
  float min_confidence;
  int64_t shared_room, touching_room;  // elements of `shared` and rows of `touching` that there is room for
  // Results: number of each pixel's segment, and of the object with the same surface, [H, W], -1 = none; the ids
  // [65536], and how many there are; pixels of each segment [65536] and of each pair [segment_count, object_count].
  int32_t* row;
  int32_t* column;
  uint16_t* segment_ids;
  uint16_t* object_ids;
  int32_t segment_count, object_count;
  int64_t* areas;
  int64_t* shared;
  uint16_t* touching;  // [touching_count, 2], ids of objects beside each other, smaller first, pairs ascending
  int64_t touching_count;
};

// A keyframe that falls into segments, [H, W].
struct SegmentedDepth {
  const int32_t* row;   // number of each pixel's segment, below `segments_end`; -1 = none
  const float* depth;   // metres, 0 = unknown
  const float* rays_x;  // [W], x / z of each column
  const float* rays_y;  // [H], y / z of each row
  int32_t height, width, segments_end;
};

// Where segments are, in the camera's frame.
struct ExtentsJob {
  SegmentedDepth image;
  const int32_t* asked;  // [count], segments, all different
  int32_t count;
  double* centres;  // [count, 3], result: mean point, 0 without depth
  double* squares;  // [count], result: mean square distance from it
};

// A segment's plane in the camera's frame.
struct SegmentPlane {
  double normal[3];  // unit, towards the camera
  double offset;     // n . x
  double middle[3];  // mean point of the segment
  double behind;     // share of all points of the image that lie behind the plane
  int32_t is_flat;   // 0: it has no plane, and the rest is 0
};

// The planes that most points of segments lie on.
struct SegmentPlanesJob {
  SegmentedDepth image;
  int32_t stride;        // every n-th pixel along each axis is used
  const int32_t* asked;  // [count], segments
  int32_t count;
  double flat_m;        // on the plane are points nearer than this up to 3 m of depth, beyond in proportion
  double min_on_plane;  // smallest share of a flat segment's points there
  double behind_m;      // behind it are points from this distance on up to 2 m of depth, beyond in proportion
  SegmentPlane* planes;  // [count], result
};

// Labels for the pixels of an image [pixels], by the numbers of their segments and objects.
struct PairLabelsJob {
  const int32_t* row;      // [pixels], below `rows`; -1 = none, which is the last row of `labels`
  const int32_t* column;   // [pixels], below `columns`; -1 = none, which is the last column
  const uint16_t* labels;  // [rows + 1, columns + 1]
  int64_t pixels;
  int32_t rows, columns;
  uint16_t* image;  // [pixels], result
};

}  // namespace ggslam

// Each works in the calling thread.
GGSLAM_EXPORT int ggslam_surface_links(const ggslam::SurfaceLinksJob* job);
GGSLAM_EXPORT int32_t ggslam_connected_pieces(const ggslam::PiecesJob* job);  // returns their number
GGSLAM_EXPORT int ggslam_grow_regions(const ggslam::GrowthJob* job);
GGSLAM_EXPORT int ggslam_claim_planes(const ggslam::PlaneClaimJob* job);
// These two return the number of rows; nothing is written if there is no room for them.
GGSLAM_EXPORT int64_t ggslam_region_borders(const ggslam::BordersJob* job);
GGSLAM_EXPORT int64_t ggslam_piece_contacts(const ggslam::ContactsJob* job);
GGSLAM_EXPORT int ggslam_regions_on_planes(const ggslam::RegionsOnPlanesJob* job);
GGSLAM_EXPORT int ggslam_region_bodies(const ggslam::BodiesJob* job);
GGSLAM_EXPORT int ggslam_surface_normals(const ggslam::NormalsJob* job);
GGSLAM_EXPORT int ggslam_alike_colors(const ggslam::AlikeColorsJob* job);
GGSLAM_EXPORT int ggslam_outlier_colors(const ggslam::OutlierColorsJob* job);
GGSLAM_EXPORT int ggslam_clean_segments(const ggslam::CleaningJob* job);
GGSLAM_EXPORT int ggslam_trust_borders(const ggslam::TrustJob* job);
GGSLAM_EXPORT int ggslam_segment_overlap(ggslam::OverlapJob* job);  // what there is no room for is counted, not written
GGSLAM_EXPORT int ggslam_label_pairs(const ggslam::PairLabelsJob* job);
GGSLAM_EXPORT int ggslam_segment_extents(const ggslam::ExtentsJob* job);
GGSLAM_EXPORT int ggslam_segment_planes(const ggslam::SegmentPlanesJob* job);
GGSLAM_EXPORT int ggslam_mark_ids(const uint16_t* ids, int64_t count, uint8_t* there);  // there [65536]: 1 of each id
