// SPDX-License-Identifier: Apache-2.0
// The CUDA kernels' evidence of what moves. Pointers lead to device memory. Functions with a status return 0 or a
// cudaError_t.
#pragma once
#include <cstddef>
#include <cstdint>

#include "abi/core/sight.hpp"
#include "abi/export.hpp"

namespace ggslam::cuda {

constexpr int kMostEarlier = 16;    // views that one is compared with
constexpr int kEvidencePlanes = 7;  // see MoverEvidenceJob::planes

// What the host asks first.
struct MoverEvidenceFound {
  double pose[12];     // that the view was compared at, as AlignJob::guess
  std::int32_t novel;  // places that `fewest_passed` earlier views looked past; one that surely did counts twice
  std::int32_t reserved;
};

// A depth image that becomes one of the coarse views, h = height / factor rows of w = width / factor places, and is
// compared with earlier ones.
struct MoverEvidenceJob {
  const float* depth;        // [height, width], metres, 0 where unknown
  const double* pose;        // [12] T_world_camera as AlignJob::guess; null: given_pose
  float* images;             // [slots, 3, h, w]: depth, near, far, see PlacesView
  std::uint8_t* flags;       // [slots, 2, h, w]: whole, smooth
  const std::uint8_t* moved; // [h, w], see PlacesEvidenceJob; may be null
  // [kEvidencePlanes, h, w]: earlier views that looked past a place, by twice the margin, surely, that saw a surface
  // there; 0 or 1: one saw this or nothing but others; a surface was there in one of kStayed; nothing but others in one
  // of kLeft.
  std::uint8_t* planes;
  MoverEvidenceFound* found;
  MoverEvidenceFound* arrived;  // in page-locked memory of the host, a copy of `found`
  void* workspace;              // see ggslam_cuda_mover_evidence_bytes
  void* stream;
  double given_pose[12];
  double T_camera_world[kMostEarlier][12];  // of the earlier views, rows of [R t]
  std::int32_t slots[kMostEarlier];
  std::int32_t parts[kMostEarlier];  // EvidencePart, added
  SightMargin margin;
  double fx, fy, cx, cy;  // of the small image
  // See PlaceTuning: a place is smooth with this many known pixels about it and a spread below smooth_sigmas.
  float least_known, smooth_sigmas, rough, least_share, nearest;
  std::int32_t every, fewest;  // see PlacesEvidenceJob
  std::int32_t device, width, height, factor, reach, slot, count, fewest_passed;
};

// What an earlier view counts for besides.
enum EvidencePart { kLeft = 1, kStayed = 2 };

}  // namespace ggslam::cuda

// Bytes of memory that the evidence works in. Asks for width, height and factor.
GGSLAM_EXPORT std::int64_t ggslam_cuda_mover_evidence_bytes(const ggslam::cuda::MoverEvidenceJob* job);

// Makes the view, compares it, and waits for what was found.
GGSLAM_EXPORT int ggslam_cuda_mover_evidence_wait(const ggslam::cuda::MoverEvidenceJob* job);
