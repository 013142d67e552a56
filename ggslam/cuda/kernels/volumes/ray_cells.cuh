// SPDX-License-Identifier: Apache-2.0
// A ray through the cells between voxels of a TSDF: the field in a cell is interpolated trilinearly and followed exactly, as
// native/src/volumes/kernels/raycast.cpp does it (which is a sixth slower on a CPU with these functions than with its own).
// Positions in voxels; voxel centres are at whole numbers.
#pragma once
#include "volumes/numbers.cuh"

namespace ggslam::cuda {

constexpr float kCloseEnough = 8;  // of 32767, at a truncation of 4 voxels a thousandth of a voxel
constexpr int kMostSteps = 6;

// Position origin + depth * direction.
struct Ray {
  float origin[3], direction[3], inverse[3];
  int step[3];
};

__device__ inline void place_on(const Ray& ray, float depth, float out[3]) {
  for (int a = 0; a < 3; ++a) out[a] = ray.origin[a] + depth * ray.direction[a];
}

// The ray through the centre of pixel (u, v); View: a camera with rotation (world from camera) and position, metres.
template <class View>
__device__ inline Ray ray_through(const View& view, int u, int v, float voxel) {
  const float local[3] = {(u - view.cx) / view.fx, (v - view.cy) / view.fy, 1};
  Ray ray;
  for (int a = 0; a < 3; ++a) {
    float d = 0;
    for (int b = 0; b < 3; ++b) d += view.rotation[3 * a + b] * local[b];
    d /= voxel;
    if (std::fabs(d) < 1e-6f) d = 1e-6f;  // as good as parallel to the voxels, but with an inverse
    ray.origin[a] = view.position[a] / voxel - 0.5f;
    ray.direction[a] = d, ray.inverse[a] = 1 / d, ray.step[a] = d > 0 ? 1 : -1;
  }
  return ray;
}

// The field in a cell: values at its corners (x + 2 y + 4 z), and its lowest corner.
struct CellField {
  float value[8];
  float origin[3];
};

__device__ inline void inside_cell(const CellField& f, const Ray& ray, float depth, float share[3]) {
  place_on(ray, depth, share);
  for (int a = 0; a < 3; ++a) share[a] = smaller_of(larger_of(share[a] - f.origin[a], 0.0f), 1.0f);
}

// Mixes with shares that are not negative: where all corners are positive, so is the field.
__device__ inline float field_at(const CellField& f, const Ray& ray, float depth) {
  float s[3], x[4];
  inside_cell(f, ray, depth, s);
  for (int c = 0; c < 4; ++c) x[c] = (1 - s[0]) * f.value[2 * c] + s[0] * f.value[2 * c + 1];
  const float low = (1 - s[1]) * x[0] + s[1] * x[1], high = (1 - s[1]) * x[2] + s[1] * x[3];
  return (1 - s[2]) * low + s[2] * high;
}

// Depth of the surface between two, the field being negative at the second only.
__device__ inline float crossing_between(const CellField& f, const Ray& ray, float a, float at_a, float b, float at_b) {
  float middle = a + (b - a) * at_a / (at_a - at_b);
  for (int i = 0; i < kMostSteps; ++i) {
    const float value = field_at(f, ray, middle);
    if (std::fabs(value) < kCloseEnough) break;
    if (value >= 0)
      a = middle, at_a = value;
    else
      b = middle, at_b = value;
    middle = a + (b - a) * at_a / (at_a - at_b);
  }
  return middle;
}

__device__ inline void cell_gradient(const CellField& f, const float s[3], float out[3]) {
  for (int a = 0; a < 3; ++a) {
    const int b = (a + 1) % 3, c = (a + 2) % 3;
    out[a] = 0;
    for (int n = 0; n < 4; ++n) {
      const int low = (n & 1) << b | (n >> 1) << c;
      const float share = (n & 1 ? s[b] : 1 - s[b]) * (n >> 1 ? s[c] : 1 - s[c]);
      out[a] += share * (f.value[low | 1 << a] - f.value[low]);
    }
  }
}

// Depth at which a ray leaves a cell of `size` voxels along an axis.
__device__ inline float cell_boundary(const Ray& ray, int axis, int start, int size) {
  const int end = start + (ray.step[axis] > 0 ? size : 0);
  return (static_cast<float>(end) - ray.origin[axis]) * ray.inverse[axis];
}

// A grid that a ray walks through: where it stands, and the depths at which it crosses the next planes of the grid.
// Plain numbers, not arrays, so that they stay in registers.
struct RaySteps {
  float next_x, next_y, next_z, stride_x, stride_y, stride_z;
  int x, y, z, step_x, step_y, step_z;
};

// From the cell of the grid at `start` (lowest corner, in voxels; cells of `size` voxels).
__device__ inline RaySteps steps_from(const Ray& ray, const int start[3], int size) {
  return {cell_boundary(ray, 0, start[0], size), cell_boundary(ray, 1, start[1], size),
          cell_boundary(ray, 2, start[2], size), size * std::fabs(ray.inverse[0]), size * std::fabs(ray.inverse[1]),
          size * std::fabs(ray.inverse[2]), start[0], start[1], start[2], size * ray.step[0], size * ray.step[1],
          size * ray.step[2]};
}

// Crosses the nearest plane (all of them, where they meet); returns the depth. Without branches: which axis is next
// cannot be foretold.
__device__ inline float advance_ray(RaySteps& s) {
  const float depth = smaller_of(s.next_x, smaller_of(s.next_y, s.next_z));
  const int on_x = -(s.next_x <= depth), on_y = -(s.next_y <= depth), on_z = -(s.next_z <= depth);
  s.x += s.step_x & on_x, s.y += s.step_y & on_y, s.z += s.step_z & on_z;
  s.next_x += s.next_x <= depth ? s.stride_x : 0.0f;
  s.next_y += s.next_y <= depth ? s.stride_y : 0.0f;
  s.next_z += s.next_z <= depth ? s.stride_z : 0.0f;
  return depth;
}

// What a ray knows of the field where it stands.
struct RayKnowledge {
  bool known;
  float last;
};

// Whether a ray meets the surface from its free side in a cell with surface, between two depths; sets `hit`. A ray from a
// cell without surface enters at a face whose corners are all outside, so that less than 0 can only be the rounding of a
// 0; or it comes from the unknown.
__device__ inline bool meets_surface(const CellField& f, const Ray& ray, float depth, float leaves, RayKnowledge& k,
                                  float& hit) {
  const float entry = k.known ? k.last : field_at(f, ray, depth), after = field_at(f, ray, leaves);
  const float before = !k.known && entry > -kCloseEnough ? larger_of(entry, 0.0f) : entry;
  if (before >= 0 && after < 0) {
    hit = crossing_between(f, ray, depth, before, leaves, after);
    return true;
  }
  k.known = true, k.last = after;
  return false;
}

}  // namespace ggslam::cuda
