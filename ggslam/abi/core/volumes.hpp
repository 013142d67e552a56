// SPDX-License-Identifier: Apache-2.0
// The compiled core's volumes: truncated signed distances, their surface, the distance field, occupancy.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/export.hpp"

namespace ggslam::volumes {

// Voxels of blocks as arrays of [blocks, 512] (colour: [blocks, 512, 3]); any may be null.
struct VoxelArrays {
  int16_t* value;
  uint16_t* weight;
  uint16_t* label;
  uint8_t* color;
  uint8_t* votes;
  uint8_t* hits;
  uint8_t* octants;
};

// Numbers of the fusion. Distances in metres.
struct FusionSettings {
  float min_depth, max_depth, free_share, edge, clearing, max_free_weight;
  int32_t integrator, least_rays;    // where voxels near the surface have their depth from, see tsdf_rays.hpp
  int32_t points;                    // whether measured points are counted
  int32_t bounded, low[3], high[3];  // where `bounded`, blocks from `low` to below `high` alone are looked at
};

// A view to be fused. `color` [H, W, 3] and `labels` [H, W] may be null.
struct FusionInput {
  const float* depth;
  const uint8_t* color;
  const uint16_t* labels;
  int32_t width, height;
  float fx, fy, cx, cy;
  double rotation[9], translation[3];  // of T_camera_world, row by row
};

// Blocks that a view touched, and the time of the stages.
struct FusionStats {
  int64_t blocks, updated, made, freed;
  double prepare_ms, select_ms, update_ms;
};

// What an update of the distance field did.
struct FieldStats {
  int64_t changed_blocks;     // of the TSDF since the last time, those that went counted
  int64_t changed_sites;      // surface points that came, went or moved
  int64_t recomputed_blocks;  // of the field
  int64_t blocks;             // the field has now
  int64_t computed_voxels;    // of the field
  int64_t stale_blocks;       // for which there was no time
  double sites_ms, select_ms, transform_ms;
};

// A distance field that was made elsewhere, of `blocks` blocks with distances and `sites` surface points in all.
struct FieldParts {
  int64_t blocks, sites;
  const int32_t* at;                              // [blocks, 3]
  const uint64_t *known, *negative, *crossed;     // [blocks, 8], voxel (i, j, k): bit i + 8 j of word k
  const float* distance;                          // [blocks, 512], metres; NaN: unknown
  const uint32_t* gradient;                       // [blocks, 512], 10 bits for each of x, y, z: 511 (1 + component)
  const uint32_t* owner;                          // [blocks, 512], 512 block + voxel of the nearest point; all bits: none
  const int32_t *site_block, *site_voxel;         // [sites], in this order; numbers of blocks and rows in them
  const float *site_at, *site_normal, *site_radius;  // [sites, 3], [sites, 3], [sites], voxels from the first one's centre
};

// Vertices [n, 3] in metres, unit normals [n, 3], colours [n, 3], labels [n]; triangles [m, 3].
struct MeshArrays {
  float* vertices;
  float* normals;
  uint8_t* colors;
  uint16_t* labels;
  int32_t* triangles;
};

// How a laser scan becomes depth images of `size` x `size` pixels with a view of 90 degrees. Lengths in metres.
struct ScanFaceSettings {
  float nearest, farthest;  // points nearer or farther are left out
  float max_edge;           // of the triangles between neighbouring points
  float min_incidence;      // least cosine between a triangle's normal and the ray to it
  int32_t columns, size;    // columns of points in a turn; pixels
};

// A camera and its pose.
struct RaycastView {
  float fx, fy, cx, cy;
  float near, far;       // depth, metres
  float rotation[9];     // world from camera
  float position[3];     // of the camera, metres
  int32_t width, height;
};

// [height, width]: depth along the optical axis in metres, 0 where no surface is seen; unit normals [.., 3] in the
// camera's axes; colours [.., 3]; labels.
struct SurfaceImages {
  float* depth;
  float* normals;
  uint8_t* colors;
  uint16_t* labels;
};

// Places [layers, rows, columns]: start + layer * layer_step + row * row_step + column * column_step, in voxels from the
// map's origin. Rows and columns are counted from first_row and first_column: a part of a grid has the grid's own places.
struct ColumnGrid {
  double start[3], layer_step[3], row_step[3], column_step[3];
  int32_t layers, rows, columns, first_row, first_column;
};
constexpr int kSeenBit = 1;
constexpr int kBehindBit = 2;

}  // namespace ggslam::volumes

namespace ggslam {

// How a scan is inserted; log-odds.
struct InsertSettings {
  double max_range;
  float origin[3];
  float hit, miss, minimum, maximum;
  std::int32_t quantize, last_voxel;  // last_voxel: rays cut at the range free the voxel they end in, too
  std::int32_t most_hits;             // where `quantize`: points of a voxel that count, each as a hit
};

// What a scan saw.
struct InsertResult {
  std::uint64_t rays, free, occupied;  // rays walked; voxels of the scan, those both passed and hit counted as occupied
};

// A depth image [height, width]; depths outside [low, high] count as none, but +inf frees space up to `free` (0: it counts
// as none, too).
struct DepthImage {
  const float* depth;
  std::int32_t width, height;
  float fx, fy, cx, cy, low, high, free;
  float T_world_camera[12];
};

// A leaf of the pruned octree.
struct OccupancyLeaf {
  float centre[3], size, log_odds;
};

// What a map holds.
struct OccupancySummary {
  std::uint64_t occupied, free;  // voxels of the finest level
  std::uint64_t blocks, nodes, bytes;
  std::int32_t known_low[3], known_high[3];        // keys of the box around all known voxels, both ends included
  std::int32_t occupied_low[3], occupied_high[3];  // likewise the occupied ones; low > high where there are none
};

}  // namespace ggslam

GGSLAM_EXPORT void* ggslam_tsdf_create(float voxel, float truncation, float max_weight);
GGSLAM_EXPORT int ggslam_tsdf_destroy(void* handle);
GGSLAM_EXPORT int ggslam_tsdf_clear(void* handle);
GGSLAM_EXPORT int64_t ggslam_tsdf_size(void* handle);
GGSLAM_EXPORT int64_t ggslam_tsdf_dense(void* handle);
GGSLAM_EXPORT int64_t ggslam_tsdf_bytes(void* handle);
GGSLAM_EXPORT uint32_t ggslam_tsdf_revision(void* handle);

// All blocks by row: coordinates [n, 3], whether they have voxels [n], weights of those that are free [n], whether
// they are frozen [n], revisions [n].
GGSLAM_EXPORT int ggslam_tsdf_list(void* handle, int32_t* at, uint8_t* dense, uint16_t* free_weight, uint8_t* frozen,
                                   uint32_t* revision);

// Voxels of the blocks at coordinates [n, 3]; those that are free throughout are written out, too. Blocks that are not
// there come out as never seen.
GGSLAM_EXPORT int ggslam_tsdf_read(void* handle, int64_t n, const int32_t* at,
                                   const ggslam::volumes::VoxelArrays* out);

// Eighths of occupied voxels that points were measured in: their middles [n, 3] in voxels from the map's origin. Returns n;
// `middles` may be null.
GGSLAM_EXPORT int64_t ggslam_tsdf_octants(void* handle, double* middles);

// What the voxels are that places [layers, rows, columns] lie in: kSeenBit, kBehindBit (behind a surface).
GGSLAM_EXPORT int ggslam_tsdf_columns(void* handle, void* context, const ggslam::volumes::ColumnGrid* grid,
                                      uint8_t* seen);

// Writes voxels of the blocks at coordinates [n, 3], made where there are none. What `in` lacks stays as it is.
GGSLAM_EXPORT int ggslam_tsdf_write(void* handle, int64_t n, const int32_t* at,
                                    const ggslam::volumes::VoxelArrays* in);

// Makes the blocks at coordinates [n, 3] free throughout, with weights [n].
GGSLAM_EXPORT int ggslam_tsdf_write_free(void* handle, int64_t n, const int32_t* at, const uint16_t* weight);

// Removes the blocks at coordinates [n, 3], where there are any.
GGSLAM_EXPORT int ggslam_tsdf_erase(void* handle, int64_t n, const int32_t* at);

// From now on decay leaves all blocks that are there alone (frozen = 1), or no longer (0).
GGSLAM_EXPORT int ggslam_tsdf_freeze(void* handle, int frozen);

// Fuses a view; see FusionInput.
GGSLAM_EXPORT int ggslam_tsdf_integrate(void* handle, void* context, const ggslam::volumes::FusionInput* input,
                                        const ggslam::volumes::FusionSettings* settings,
                                        ggslam::volumes::FusionStats* stats);

// Multiplies the weights of blocks that are not frozen; voxels whose weight falls below `least` are forgotten. Returns
// the number of blocks forgotten.
GGSLAM_EXPORT int64_t ggslam_tsdf_decay(void* handle, void* context, float factor, int least, int spare_in_view);

// Where the surface runs, of voxels with at least `min_weight` (65535ths of the largest). Good until the map changes.
GGSLAM_EXPORT void* ggslam_surface_cells_create(void* context, void* tsdf, uint16_t min_weight);
GGSLAM_EXPORT int ggslam_surface_cells_destroy(void* cells);

// Counts the mesh's vertices and triangles (`sizes` [2]); `cells` must outlive what is returned.
GGSLAM_EXPORT void* ggslam_mesher_create(void* context, void* cells, int64_t* sizes);
GGSLAM_EXPORT int ggslam_mesher_write(void* context, void* mesher, const ggslam::volumes::MeshArrays* out);
GGSLAM_EXPORT int ggslam_mesher_destroy(void* mesher);
GGSLAM_EXPORT int ggslam_raycast(void* context, void* cells, const ggslam::volumes::RaycastView* view,
                                 const ggslam::volumes::SurfaceImages* out);

// Depth [faces, size, size] of points [n, 3] around the sensor, in metres, 0 where nothing was measured; `faces` [faces,
// 9]: right, down and forward of each, row by row. Returns the number of triangles between points.
GGSLAM_EXPORT int64_t ggslam_scan_faces(void* context, const ggslam::volumes::ScanFaceSettings* settings,
                                        const float* points, std::uint64_t n, const float* faces, std::int32_t count,
                                        float* depth);

// The TSDF must live as long as the field.
GGSLAM_EXPORT void* ggslam_esdf_create(void* tsdf, float max_distance);
GGSLAM_EXPORT int ggslam_esdf_destroy(void* handle);
GGSLAM_EXPORT int ggslam_esdf_clear(void* handle);

// Takes over a field of the TSDF as it is now.
GGSLAM_EXPORT int ggslam_esdf_write(void* handle, const ggslam::volumes::FieldParts* parts);
GGSLAM_EXPORT int64_t ggslam_esdf_size(void* handle);
GGSLAM_EXPORT int64_t ggslam_esdf_bytes(void* handle);

// Brings the field up to date. budget_ms: of the whole update, not positive: as long as it takes; place [3] in metres: what
// is near it comes first, null: in any order.
GGSLAM_EXPORT int ggslam_esdf_update(void* handle, void* context, double budget_ms, const double* place,
                                     ggslam::volumes::FieldStats* stats);

// Computes all blocks anew from the surface points that the field holds.
GGSLAM_EXPORT int ggslam_esdf_recompute(void* handle, void* context, ggslam::volumes::FieldStats* stats);

// Coordinates [n, 3] of all blocks.
GGSLAM_EXPORT int ggslam_esdf_list(void* handle, int32_t* at);

// Distances [n, 512] of the blocks at coordinates [n, 3]; NaN: unknown.
GGSLAM_EXPORT int ggslam_esdf_read(void* handle, int64_t n, const int32_t* at, float* distance);

// Number of surface points of all blocks; their positions [n, 3] and the radii of the discs around them [n] (metres) and
// normals [n, 3], unless null.
GGSLAM_EXPORT int64_t ggslam_esdf_sites(void* handle, float* points, float* normals, float* radii);

// At points [n, 3] in metres: distances [n] (metres), gradients [n, 3], whether they are known [n], and whether what is
// known is of an earlier update, which the last one had no time for [n].
GGSLAM_EXPORT int ggslam_esdf_query(void* handle, void* context, int64_t n, const double* points, float* distance,
                                    float* gradient, uint8_t* known, uint8_t* stale);
GGSLAM_EXPORT void* ggslam_occupancy_create(double resolution);
GGSLAM_EXPORT int ggslam_occupancy_destroy(void* map);

// 0: the origin is outside the grid, nothing was done.
GGSLAM_EXPORT int ggslam_occupancy_insert(void* context, void* map, const float* points, std::uint64_t n,
                                          const ggslam::InsertSettings* settings, ggslam::InsertResult* result);
GGSLAM_EXPORT int ggslam_occupancy_insert_depth(void* context, void* map, const ggslam::DepthImage* image,
                                                const ggslam::InsertSettings* settings, ggslam::InsertResult* result);
GGSLAM_EXPORT int ggslam_occupancy_look_up(void* context, void* map, const float* points, std::uint64_t n,
                                           float threshold, std::int8_t* states, float* log_odds);
GGSLAM_EXPORT int ggslam_occupancy_summary(void* map, float threshold, ggslam::OccupancySummary* summary);
GGSLAM_EXPORT int ggslam_occupancy_compare(void* one, void* other, float threshold_one, float threshold_other,
                                           std::uint64_t* counts);

// The following make an output, kept until the next of them is called, and return its size in bytes.
GGSLAM_EXPORT const void* ggslam_occupancy_output(void* map);
GGSLAM_EXPORT std::uint64_t ggslam_occupancy_leaves(void* map, float threshold, int which);
GGSLAM_EXPORT std::uint64_t ggslam_occupancy_write(void* map, int format, float threshold, std::uint64_t* nodes);

// Returns an OctomapFault.
GGSLAM_EXPORT int ggslam_occupancy_read(void* map, int format, const std::uint8_t* data, std::uint64_t size, float free,
                                        float occupied, std::uint64_t maximum_blocks, std::uint64_t* nodes);

// Keys (uint16 [m, 3]) of the voxels that a scan sees, the free ones first; -1: the origin is outside the grid.
GGSLAM_EXPORT std::int64_t ggslam_occupancy_scan_keys(void* context, void* map, const float* points, std::uint64_t n,
                                                      const ggslam::InsertSettings* s, ggslam::InsertResult* result);

// Distinct voxels of n points: keys (uint16 [m, 3], room for n) and how many points lie in each (int32 [m]; may be
// null). Returns m.
GGSLAM_EXPORT std::uint64_t ggslam_quantize(void* context, double resolution, const float* points, std::uint64_t n,
                                            std::uint16_t* keys, std::int32_t* counts);
