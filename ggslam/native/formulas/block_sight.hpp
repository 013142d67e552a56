// SPDX-License-Identifier: Apache-2.0
// What a view tells about a cube of blocks. The cube is compared with the depth in its footprint (the pixels on which the
// box that encloses it along the camera's axes falls, rounded out to whole tiles) tile by tile: over the stretch of depth
// that the rays through the tile have in common with the cube.
#pragma once
#include <cmath>
#include <cstdint>

#include "native/formulas/formulas.hpp"
#include "native/formulas/tsdf_rules.hpp"

namespace GGSLAM_FORMULAS {

// What a cube's footprint shows, bits: depth behind it, in front of it, at it (each by more or less than the truncation),
// or depth at it that is beyond the range. Once there is depth at it, the others are no longer looked for.
enum : unsigned { kSeenBehind = 1, kSeenInFront = 2, kSeenAt = 4, kSeenPassed = 8 };

// A camera among blocks of edge `block` metres.
struct BlockCamera {
  std::int32_t width, height;
  float fx, fy, cx, cy;
  double rotation[9], translation[3];  // of T_camera_map
  double position[3];                  // of the camera
  double block;
  float axes[9];                       // of the camera in the map
  float extent[3];                     // half extents of a block along the camera's axes
  float spread[3];                     // along the map's axes at z = 1, of one pixel
  float truncation, max_depth, free_share;
};

// The camera of T_camera_map, row by row; the numbers of the fusion are left to be filled in.
GGSLAM_HOST_FORMULA BlockCamera block_camera(std::int32_t width, std::int32_t height, float fx, float fy, float cx,
                                             float cy, const double* rotation, const double* translation,
                                             double block) {
  BlockCamera c{};
  c.width = width, c.height = height, c.fx = fx, c.fy = fy, c.cx = cx, c.cy = cy, c.block = block;
  for (int k = 0; k < 9; ++k) c.rotation[k] = rotation[k];
  for (int a = 0; a < 3; ++a) {
    c.translation[a] = translation[a];
    const double *r = rotation + 3 * a, *column = rotation + a;
    c.position[a] = -1.0 * (column[0] * translation[0] + column[3] * translation[1] + column[6] * translation[2]);
    c.extent[a] = static_cast<float>(0.5 * block * (std::fabs(r[0]) + std::fabs(r[1]) + std::fabs(r[2])));
    for (int b = 0; b < 3; ++b) c.axes[3 * a + b] = static_cast<float>(rotation[3 * b + a]);
    c.spread[a] = std::fabs(c.axes[3 * a]) / fx + std::fabs(c.axes[3 * a + 1]) / fy;
  }
  return c;
}

// The box around what the camera sees up to a depth, in metres.
GGSLAM_HOST_FORMULA void seen_box(const BlockCamera& c, double far, double (&low)[3], double (&high)[3]) {
  const double right[2] = {(-0.5 - c.cx) / c.fx, (c.width - 0.5 - c.cx) / c.fx};
  const double down[2] = {(-0.5 - c.cy) / c.fy, (c.height - 0.5 - c.cy) / c.fy};
  for (int corner = -1; corner < 4; ++corner) {
    const double z = corner < 0 ? 0 : far, x = z * right[corner & 1], y = z * down[(corner >> 1) & 1];
    for (int a = 0; a < 3; ++a) {
      const double p = c.position[a] + x * static_cast<double>(c.axes[3 * a]) +
                       y * static_cast<double>(c.axes[3 * a + 1]) + z * static_cast<double>(c.axes[3 * a + 2]);
      low[a] = corner < 0 || p < low[a] ? p : low[a];
      high[a] = corner < 0 || p > high[a] ? p : high[a];
    }
  }
}

struct SeenCube {
  float centre[3];  // in the camera's frame
  float near, far;  // depth of its nearest and farthest corner
  float offset[3];  // centre from the camera along the map's axes
  float half;       // of the edge
};

struct Footprint {
  int u0, v0, u1, v1;  // tiles, inclusive
  bool whole;          // nothing is cut off at the image's border or near the camera
};

// A cube of side^3 blocks from one.
GGSLAM_FORMULA SeenCube seen_cube(const BlockCamera& c, std::int32_t x, std::int32_t y, std::int32_t z, int side) {
  const double p[3] = {c.block * (x + 0.5 * side), c.block * (y + 0.5 * side), c.block * (z + 0.5 * side)};
  SeenCube out;
  out.half = static_cast<float>(0.5 * side * c.block);
  for (int a = 0; a < 3; ++a) {
    const double* r = c.rotation + 3 * a;
    out.centre[a] = static_cast<float>(r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + c.translation[a]);
    out.offset[a] = static_cast<float>(p[a] - c.position[a]);
  }
  out.near = out.centre[2] - side * c.extent[2], out.far = out.centre[2] + side * c.extent[2];
  return out;
}

// The tiles on which a cube falls; false if there are none.
GGSLAM_FORMULA bool footprint_of(const BlockCamera& c, const SeenCube& cube, int side, Footprint& out) {
  const float far = cube.far, start = larger_of(cube.near, volumes::kNear);
  if (far <= volumes::kNear) return false;
  const float sizes[2] = {static_cast<float>(c.width), static_cast<float>(c.height)};
  const float focal[2] = {c.fx, c.fy}, middle[2] = {c.cx, c.cy};
  int low[2], high[2];
  out.whole = cube.near >= volumes::kNear;
  for (int a = 0; a < 2; ++a) {
    const float left = cube.centre[a] - side * c.extent[a], right = cube.centre[a] + side * c.extent[a];
    const float p0 = focal[a] * left / (left < 0 ? start : far) + middle[a] + 0.5f;
    const float p1 = focal[a] * right / (right > 0 ? start : far) + middle[a] + 0.5f;
    if (p1 < 0 || p0 >= sizes[a]) return false;
    out.whole = out.whole && p0 >= 0 && p1 < sizes[a];
    low[a] = static_cast<int>(larger_of(p0, 0.0f)) / volumes::kTile;
    high[a] = static_cast<int>(smaller_of(p1, sizes[a] - 1)) / volumes::kTile;
  }
  out.u0 = low[0], out.v0 = low[1], out.u1 = high[0], out.v1 = high[1];
  return true;
}

// The stretch of depth in which rays through tile (u, v) of a level meet a cube; false if none does. Along each axis of
// the map, the rays at depth z spread over z (direction +- spread).
GGSLAM_FORMULA bool tile_meets(const BlockCamera& c, int level, int u, int v, const SeenCube& cube, float& z0,
                               float& z1) {
  const float half = 0.5f * static_cast<float>(volumes::kTile << level);
  const float x = ((2 * u + 1) * half - 0.5f - c.cx) / c.fx, y = ((2 * v + 1) * half - 0.5f - c.cy) / c.fy;
  z0 = larger_of(cube.near, volumes::kNear), z1 = cube.far;
  for (int a = 0; a < 3; ++a) {
    const float direction = c.axes[3 * a] * x + c.axes[3 * a + 1] * y + c.axes[3 * a + 2];
    const float spread = half * c.spread[a];
    const float low = cube.offset[a] - cube.half, high = cube.offset[a] + cube.half;
    // z (direction + spread) >= low and z (direction - spread) <= high
    const float most = direction + spread, least = direction - spread;
    if (most > 0) z0 = larger_of(z0, low / most);
    else if (most < 0) z1 = smaller_of(z1, low / most);
    else if (low > 0) return false;
    if (least > 0) z1 = smaller_of(z1, high / least);
    else if (least < 0) z0 = larger_of(z0, high / least);
    else if (high < 0) return false;
  }
  return z0 <= z1;
}

// What a tile with depth from `nearest` to `farthest` shows of a cube, as bits. `closer`: that has to be seen from its
// parts (smaller tiles, or pixels), over the stretch of depth from `low` to `high`.
GGSLAM_FORMULA unsigned tile_shows(const BlockCamera& c, int level, int u, int v, float nearest, float farthest,
                                   const SeenCube& cube, bool& closer, float& low, float& high) {
  closer = false;
  if (farthest <= 0) return 0;
  if (nearest > cube.far + c.truncation) return kSeenBehind;
  if (farthest < cube.near - c.truncation) return kSeenInFront;
  if (!tile_meets(c, level, u, v, cube, low, high)) return 0;
  low -= c.truncation, high += c.truncation;
  if (nearest > high) return kSeenBehind;
  if (farthest < low) return kSeenInFront;
  closer = true;
  if (level > 0 || farthest > c.max_depth || !(nearest >= low || farthest <= high)) return 0;
  closer = false;
  return kSeenAt;
}

// The same of a pixel of a tile.
GGSLAM_FORMULA unsigned pixel_shows(const BlockCamera& c, float depth, float low, float high) {
  if (depth <= 0) return 0;
  return depth > high ? kSeenBehind : depth < low ? kSeenInFront : depth > c.max_depth ? kSeenPassed : kSeenAt;
}

}  // namespace GGSLAM_FORMULAS
