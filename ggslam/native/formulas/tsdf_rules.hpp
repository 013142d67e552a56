// SPDX-License-Identifier: Apache-2.0
// Numbers of the truncated signed distance field and of the distance field made of it, for CPU and GPU.
#pragma once
#include <cstdint>

namespace ggslam::volumes {

constexpr int kSide = 8;  // voxels along an edge of a block
constexpr int kVoxels = kSide * kSide * kSide;
constexpr std::int16_t kFreeValue = 32767;
constexpr std::uint16_t kFullWeight = 65535;

// A voxel's distance tells of surfaces that are larger than it; what is thin is averaged away. Points are counted beside
// it, as OctoMap counts them: log-odds in steps, clamped, of hits (the view has a point in the voxel) and misses (it looks
// past the voxel's centre by more than a voxel). These are those of OccupancySettings.with_raised_odds, 23.6 steps a unit.
constexpr int kNeverSeen = 0, kOccupied = 128;  // occupied from this value on
constexpr int kHit = 41, kMiss = 20, kLeastHits = kOccupied - 47, kMostHits = kOccupied + 83;

constexpr int kTile = 4;        // pixels along an edge of the depth pyramid's smallest tiles
constexpr int kErosion = 2;     // pixels: what is looked through must be so in this neighbourhood
constexpr float kNear = 0.02f;  // metres; what is nearer is not projected

constexpr float kSurprise = 0.5f;           // of the truncation: how far depth must contradict a voxel to clear it
constexpr float kDoubt = 0.03f;             // of a voxel's depth: passing it by so little more proves nothing
constexpr float kDoubtfulShare = 0.03f;     // of the voxel's weight that what proves nothing counts at most
constexpr float kFreeFrom = 0.98f * kFreeValue;  // a voxel seen as free counts as free from this value on
constexpr float kRangeSlack = 1.00001f;     // of the range: rounding when depth is added up again
constexpr float kLabelVoxels = 2.0f;        // labels are told to voxels this near to the surface
constexpr float kColorShare = 0.125f;       // of a new colour at least: less would be rounded away

// Rays that pass a voxel's centre farther away than this, in metres, tell of another place: the surface may bend between.
// Found on a generated room with a Kinect's noise, voxels of 1 to 10 cm; another room agrees. Where depth is exact rays
// gain nothing.
constexpr double kRayRadius = 0.02;
constexpr int kRayUnits = 2048;  // to the truncation, in which rays' distances are summed: 2^20 rays may add up

}  // namespace ggslam::volumes
