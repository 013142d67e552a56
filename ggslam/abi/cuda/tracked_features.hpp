// SPDX-License-Identifier: Apache-2.0
// The CUDA kernels' tracking by edges and planes: the work of ggslam/tracking/edges_planes. Pointers lead to device
// memory. Calls only start work on the caller's stream, but for ggslam_cuda_feature_track_wait; those with a status return
// 0 or a cudaError_t.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/cuda/sight.hpp"
#include "abi/export.hpp"

namespace ggslam::cuda {

// What the device alone knows of the features of a scan.
struct FeatureHeader {
  std::int32_t planes, edges;  // numbers of them
  float median_depth;          // of the planes along the third axis, metres; 0 without
  float median_distance;       // of the planes from the sensor
  float thin_median_distance;  // the same of those that are aligned
};

// The features of a scan as of ScanFeatures; `header` says how many are in use.
struct FeatureArrays {
  FeatureHeader* header;
  float* planes;        // [n, 3]
  float* normals;       // [n, 3]
  float* discs;         // [n]
  float* plane_sigmas;  // [n]
  float* edges;         // [m, 3]
  float* edge_sigmas;   // [m]
};

// Scan lines of a depth image and what is looked for on them, see ExtractionSettings.
struct FeatureSettings {
  float fx, fy, cx, cy;
  float noise_constant, noise_square, min_depth, max_depth;
  float squared_roughness, edge_curvature, plane_curvature;  // limits of curvature, in variances
  float turn_cosine, gap;
  float plane_sigmas, roughness, min_cosine, disc_per_depth;  // of patches
  std::int32_t width, height, pitch;
  // Lines: `rows` of them begin at row first_row, the others at column first_column; each has `length` places, of which
  // those beyond the image are empty. Places with ten neighbours lie in `segments` of `segment` places each.
  std::int32_t lines, rows, first_row, row_step, first_column, column_step, length, segments, segment;
  std::int32_t edges_per_segment, planes_per_segment, occluding_edges;
  std::int32_t patch_step;  // pixels
};

// Leaves small segments out of a depth image, h rows of w places, each of which speaks for pitch x pitch pixels. Null
// pointers: no segments are looked for.
struct ScanSegmentsJob {
  // Sine and 1 - cosine of the angle between the rays of neighbours, in a row [h, w - 1] and in a column [h - 1, w].
  const float *across_sine, *across_versine, *down_sine, *down_versine;
  const float* lengths;  // [h, w] of rays with z = 1
  float* filtered;       // [height, width]
  float tangent, sigmas;
  std::int32_t w, h, least;  // least: pixels of a segment that stays
};

// Features to take from a depth image.
struct FeatureScanJob {
  const float* depth;   // [height, width], metres, 0 where unknown
  const float* dither;  // [rows, length - 10], see LineScanner
  FeatureArrays out;    // with room for all that segments may give, see ggslam_cuda_feature_room
  void* workspace;      // see ggslam_cuda_feature_scan_bytes
  void* stream;
  ScanSegmentsJob small;
  FeatureSettings settings;
  std::int32_t device, most_planes, most_edges;  // most: of those that are aligned
};

// The voxels of the local map, as FeatureMap has them.
struct FeatureTable {
  std::int64_t* keys;  // [slots], -1: free
  float* weights;      // [slots]
  float* surfaces;     // [slots, 8]
  float* scatters;     // [slots, 6]
  std::int64_t slots;  // a power of two
  std::int32_t shift;  // 64 minus its logarithm
  float plane_voxel, edge_voxel, planes_per_metre, edges_per_metre;
  float match_voxels, min_normal_dot, max_weight, min_plane_points, min_edge_points, plane_ratio, edge_ratio;
};

// A scan to be added to the local map.
struct FeatureAddJob {
  FeatureArrays scan;
  FeatureTable table;
  void* workspace;  // see ggslam_cuda_feature_add_bytes
  void* stream;
  float pose[12];            // T_map_sensor: rotation row by row, then translation
  std::int32_t device, room;  // room: features at most
};

// See FeatureAlignSettings.
struct FeatureAlignLimits {
  double rematch_distance;  // metres
  double translation_tolerance, rotation_tolerance;
  float huber_sigmas, gate_constant, gate_sigmas, edge_weight, overlap_constant, overlap_sigmas;
  std::int32_t planes, edges, outer_iterations, inner_iterations, min_matches;
};

// A scan to be aligned to the local map.
struct FeatureAlignJob {
  FeatureArrays scan;
  FeatureTable table;
  std::int32_t* matches;  // [room] working memory, room for the features that are aligned
  double* results;        // [kFeatureResults], in the order of FeatureResult
  void* stream;
  double guess[12];        // T_map_sensor: rotation row by row, then translation
  double T_world_map[12];
  FeatureAlignLimits limits;
  std::int32_t device;
};

// Places of the results.
enum FeatureResult {
  kFeatureWorldPose,                           // T_world_sensor as FeatureAlignJob::guess
  kFeaturePose = kFeatureWorldPose + 12,       // T_map_sensor
  kFeatureInformation = kFeaturePose + 12,     // [21], upper triangle row by row, of a twist about the sensor, map axes
  kFeatureRows = kFeatureInformation + 21,     // residuals
  kFeatureSettled, kFeatureMatchings, kFeatureSteps,
  kFeatureInliers, kFeatureSquared,            // planes on a plane of the map; sum of their squared distances
  kFeatureWeight, kFeatureCentroid,            // sum of weights of the residuals; mean point with these, sensor's frame
  kFeatureRadius = kFeatureCentroid + 3,       // root mean square distance from it
  kFeatureAligned,                             // planes
  kFeaturePlanes, kFeatureEdges, kFeatureMedianDepth, kFeatureMedianDistance,  // of the scan's header
  kFeatureResults
};

// All the work of a frame: what is wanted of its parts, one after the other.
struct FeatureTrackJob {
  FeatureAddJob add;
  FeatureScanJob scan;
  FeatureAlignJob align;
  MoverEvidenceJob evidence;
  double* results;  // [kFeatureResults] in page-locked memory of the host, a copy of those of `align`
  std::int32_t clears, adds, scans, makes_evidence;  // clears: the local map, first of all
};

}  // namespace ggslam::cuda

// Planes, or edges, that a scan has at most. Asks for the settings of lines and segments.
GGSLAM_EXPORT std::int64_t ggslam_cuda_feature_room(const ggslam::cuda::FeatureScanJob* job, std::int32_t edges);

// Bytes of memory that extraction works in. Asks for settings and segments.
GGSLAM_EXPORT std::int64_t ggslam_cuda_feature_scan_bytes(const ggslam::cuda::FeatureScanJob* job);

// Extracts features.
GGSLAM_EXPORT int ggslam_cuda_feature_scan(const ggslam::cuda::FeatureScanJob* job);

// Medians of features that came from elsewhere. Asks for `out` and `most_planes`.
GGSLAM_EXPORT int ggslam_cuda_feature_medians(const ggslam::cuda::FeatureScanJob* job);

// Bytes of memory that adding works in. Asks for room.
GGSLAM_EXPORT std::int64_t ggslam_cuda_feature_add_bytes(const ggslam::cuda::FeatureAddJob* job);

// Clears the local map if that is wanted, and adds a scan if that is.
GGSLAM_EXPORT int ggslam_cuda_feature_update(const ggslam::cuda::FeatureTrackJob* job);

// Does what is wanted, aligns, and waits for the results.
GGSLAM_EXPORT int ggslam_cuda_feature_track_wait(const ggslam::cuda::FeatureTrackJob* job);
