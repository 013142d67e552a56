// SPDX-License-Identifier: Apache-2.0
// The CUDA kernels of volumes: signed distances of depth images, the distance field made of them, rays cast into them.
// Pointers lead to device memory. Calls only start work on the caller's stream; those with a status return 0 or a
// cudaError_t.
//
// All memory is the caller's. What does not fit stops the map: the operation at work changes nothing that counts, and
// neither do those after it, until the caller has given it more room and set `kStoppedAt` back to 0; from the operation of
// that number on they are then started again.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/export.hpp"
#include "abi/core/volumes.hpp"

namespace ggslam::cuda {

// Voxel (i, j, k) of a block stands at row i + 8 j + 64 k; what the numbers mean is stated in ggslam/volumes/tsdf.py.
struct FusedVoxels {
  std::int16_t value[512];
  std::uint16_t weight[512];
  std::uint16_t label[512];
  std::uint8_t red[512], green[512], blue[512];
  std::uint8_t votes[512];
};

struct FusedPoints {
  std::uint8_t hits[512];
  std::uint8_t octants[512];
};

struct FusedBlock {
  std::int32_t at[3];
  std::int32_t slot;         // of its voxels; -1: free throughout
  std::int32_t free_weight;  // then: of all its voxels, in 65535ths of the largest
  std::int32_t present;      // 0: the map has no such block (anew, or never had)
  std::uint32_t revision;    // of the map when the block last changed
  std::int32_t update;       // its number among the updates of the view at work, if that has its row
};

// A block that a view tells about.
struct FusedCandidate {
  std::uint64_t key;
  float z;             // depth of the block's centre
  std::int32_t row;    // in the map; -1: none yet
  std::int32_t sight;  // see FusedSight
};

// A block whose voxels a view changes.
struct FusedUpdate {
  std::int32_t row, slot;
  std::int32_t was_present, was_free;  // free throughout, or not present
};

// What rays told a voxel: the sum of its distances to their depth, and their number.
struct FusedRays {
  std::int32_t distance, count;
};

// Numbers of a map, int32: those that last, and those of the operation at work.
enum FusedCount : int {
  kRowsUsed,
  kSlotsUsed,      // slots that were ever used; those among the free ones are free again
  kFreeSlots,
  kPresentBlocks,
  kDenseBlocks,
  kSiteSlotsUsed,  // of the distance field
  kFieldRevision,  // revision of the map that the field stands for
  kStoppedAt,      // number of the operation that did not fit; 0: none
  kRowsNeeded,     // then: how many of each it would have taken
  kSlotsNeeded,
  kListNeeded,
  kUpdatesNeeded,
  kSiteSlotsNeeded,
  kCandidateCount,
  kUpdateCount,
  kNewRows,
  kNewSlots,
  kMadeBlocks,
  kFreedBlocks,
  kChangedRows,     // of the distance field's update
  kListedRows,
  kSiteRows,
  kArrivedSlots,
  kConcernedRows,
  kChangedSites,
  kComputedVoxels,
  kLevelCounts      // of the cubes of each level of the search, and behind them
};
constexpr int kMostLevels = 24;
constexpr int kFusedCounts = 64;

// A map's memory. Blocks are found by their coordinates: 64-bit keys in open addressing.
struct FusedMap {
  std::uint64_t* keys;   // [place_mask + 1]; all bits set: empty
  std::int32_t* rows;    // [place_mask + 1]
  FusedBlock* blocks;    // [row_room]
  FusedVoxels* voxels;   // [slot_room]
  FusedPoints* points;   // [slot_room]; null: points are not counted
  std::int32_t* free_slots;  // [slot_room]
  std::int32_t* counts;  // [kFusedCounts]
  std::int32_t place_mask, row_room, slot_room;
  float voxel, truncation, max_weight;
};

// A view to be fused. Working memory may be anything but where it says so.
struct FuseJob {
  FusedMap map;
  const float* depth;             // [H, W], metres along the optical axis
  const std::uint8_t* color;      // [H, W, 3]; may be null
  const std::uint16_t* labels;    // [H, W]; may be null
  float* prepared;                // [(H + 1) W + 16]
  float* eroded;                  // [H, W]; null where nothing is cleared
  float* tiles;                   // see ggslam_cuda_fuse_tiles
  std::int32_t* valid;            // [tile rows + 1, tile columns + 1]
  std::uint64_t* cubes;           // [2, list_room]
  FusedCandidate* candidates;     // [list_room]
  FusedUpdate* updates;           // [update_room]
  std::uint32_t* octants;         // [update_room, 128]: zero before and after; null: points are not counted
  FusedRays* rays;                // [update_room, 512]: zero before and after; null: depth is looked up by projection
  void* stream;
  double rotation[9], translation[3];  // of T_camera_map, row by row
  volumes::FusionSettings settings;    // whose bounds are not used
  float fx, fy, cx, cy;
  std::int32_t width, height, device;
  std::int32_t number;            // of the operation, from 1 on
  std::int32_t revision;          // of the map with it
  std::int32_t list_room, update_room;
  std::int32_t cut_beyond;        // whether depth beyond the range counts as none
  std::int32_t grid;              // blocks of the kernels whose work the device alone knows
};

// A map's memory moved to larger memory: the places of its keys are made anew.
struct FusedMoveJob {
  FusedMap from, to;  // counts are the same
  void* stream;
  std::int32_t device;
};

// A disc of some thickness with sites in it: what is farther from it than a distance is farther from all of them. Lengths
// in voxels, from the centre of the block's first voxel.
struct FieldNode {
  float middle[3], normal[3];
  float radius, half;  // half the thickness
  float within[3];     // the middle of one of the sites
  std::int32_t count;  // of sites; 0: none
  std::int32_t at[3];  // of the block
  std::int32_t unused;
};

// The surface in a block: a disc for each of its voxels that has one. Voxels are in parts of 4^3: number 64 p + x + 4 y +
// 16 z is voxel (x, y, z) of part p, which is part (p & 1, p >> 1 & 1, p >> 2). Bit 64 p + ... of masks likewise.
struct FieldSites {
  float at[3][512], normal[3][512];  // as FieldNode; normal zero: unknown, and a point rather than a disc
  float radius[512];
  std::uint64_t held[8], came[8], gone[8];  // there; new or moved, and gone or moved, since distances were last made
  std::int32_t row, touched;                // of its block; whether some came or went
};

// What a distance field knows of a block of the map.
struct FieldRow {
  std::uint64_t known[8], negative[8], crossed[8];  // voxel (i, j, k): bit i + 8 j of word k
  std::uint64_t done_known[8], done_negative[8];    // what its distances were made for
  float farthest;          // no known voxel is farther from its site, voxels
  std::int32_t computed;   // 0: it has no distances
  std::int32_t site_slot;  // 1 + that of its sites; 0: it never had one
  std::int32_t marks;      // bits: its crossings, its sites are to be found
};

// Distances of a block's voxels.
struct FieldDistances {
  float distance[512];          // metres, negative behind the surface; NaN: unknown
  std::uint32_t gradient[512];  // 10 bits for each of x, y, z: 511 (1 + component)
  std::uint32_t owner[512];     // 512 slot + number of the nearest site; all bits set: none is near enough
};

// A distance field's memory.
struct FieldArrays {
  FieldRow* rows;             // [row_room] of the map; zero when new
  FieldDistances* distances;  // [row_room] of the map
  FieldSites* sites;          // [site_room]
  FieldNode* nodes;           // [9, site_room]: of all sites of a block, and of those of its 8 parts
  FieldNode* arrivals;        // [9, site_room]: of those that came, where `touched`
  std::int32_t* listed;       // [row_room]
  std::int32_t* arrived;      // [site_room]
  std::int32_t site_room;
};

// An update of a distance field.
struct FieldJob {
  FusedMap map;
  FieldArrays field;
  void* stream;
  std::int32_t device, number, grid;
  std::int32_t anew;   // whether all distances are made anew from the sites that are held
  float max_distance;  // voxels
};

// The surface of a map as a camera sees it. Rays go to the first change from free space to the inside.
struct CastJob {
  FusedMap map;
  std::uint64_t* cells;  // [row_room, 8]: those with surface, by their lowest voxel (i, j, k): bit i + 8 j of word k
  std::uint8_t* kinds;   // [row_room], bits: a voxel is inside; there are cells with surface
  // Images, all 0 where no surface is seen: depth along the optical axis [H, W] in metres, unit normals in the camera's
  // axes [H, W, 3], colours [H, W, 3], labels [H, W].
  float *depth, *normals;
  std::uint8_t* colors;
  std::uint16_t* labels;
  void* stream;
  float fx, fy, cx, cy, nearest, farthest;
  float rotation[9], position[3];  // world from camera; of the camera, metres
  std::int32_t width, height, device, grid;
  std::int32_t least_weight;  // voxels of less, in 65535ths of the largest, are unknown; at least 1
};

}  // namespace ggslam::cuda

// Floats in FuseJob.tiles: smallest and largest depth of tiles of 4 pixels along an edge, and of twice as many, and so on.
GGSLAM_EXPORT std::int64_t ggslam_cuda_fuse_tiles(std::int32_t width, std::int32_t height);

// Empties a map.
GGSLAM_EXPORT int ggslam_cuda_fused_clear(const ggslam::cuda::FusedMoveJob* job);

// Copies what is used of a map.
GGSLAM_EXPORT int ggslam_cuda_fused_move(const ggslam::cuda::FusedMoveJob* job);

GGSLAM_EXPORT int ggslam_cuda_fuse(const ggslam::cuda::FuseJob* job);

// Brings a distance field up to date with its map.
GGSLAM_EXPORT int ggslam_cuda_field_update(const ggslam::cuda::FieldJob* job);

GGSLAM_EXPORT int ggslam_cuda_cast_rays(const ggslam::cuda::CastJob* job);
