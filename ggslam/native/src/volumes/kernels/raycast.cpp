// SPDX-License-Identifier: Apache-2.0
// Rays walk through blocks that hold surface, and in them from cell to cell (J. Amanatides and A. Woo, "A Fast Voxel
// Traversal Algorithm for Ray Tracing", 1987). In a cell with surface the field along the ray is followed exactly.
#include "volumes/raycast.hpp"

#include <algorithm>
#include <cmath>

namespace ggslam::GGSLAM_ISA {
namespace {

using namespace volumes;

constexpr float kCloseEnough = 8;  // of 32767, at a truncation of 4 voxels a thousandth of a voxel
constexpr int kMostSteps = 6;

// Position origin + depth * direction, in voxels; voxel centres are at whole numbers.
struct Ray {
  float origin[3], direction[3], inverse[3];
  int step[3];

  void place(float depth, float out[3]) const {
    for (int a = 0; a < 3; ++a) out[a] = origin[a] + depth * direction[a];
  }
};

// The voxels at the corners (x + 2 y + 4 z) of a cell of a block.
struct Corners {
  const VoxelBlock* voxels[8];
  int row[8];

  Corners(const SurfaceBlock& block, const int cell[3]) {
    const bool within = cell[0] < kSide - 1 && cell[1] < kSide - 1 && cell[2] < kSide - 1;
    for (int c = 0; c < 8; ++c) {
      const int x = cell[0] + (c & 1), y = cell[1] + ((c >> 1) & 1), z = cell[2] + (c >> 2);
      voxels[c] = block.voxels[within ? kHere : around_index(x >> 3, y >> 3, z >> 3)];
      row[c] = (x & 7) + 8 * (y & 7) + 64 * (z & 7);
    }
  }
};

// The field in a cell.
struct CellField {
  float value[8];
  float origin[3];

  CellField(const SurfaceBlock& block, const int cell[3]) {
    if (cell[0] < 7 && cell[1] < 7 && cell[2] < 7) {
      const int16_t* v = block.voxels[kHere]->value + cell[0] + 8 * cell[1] + 64 * cell[2];
      for (int c = 0; c < 8; ++c) value[c] = v[(c & 1) + 8 * ((c >> 1) & 1) + 64 * (c >> 2)];
    } else {
      const Corners at(block, cell);
      for (int c = 0; c < 8; ++c) value[c] = at.voxels[c]->value[at.row[c]];
    }
    const int32_t first[3] = {block.at.x, block.at.y, block.at.z};
    for (int a = 0; a < 3; ++a) origin[a] = static_cast<float>(kSide * first[a] + cell[a]);
  }

  void inside(const Ray& ray, float depth, float share[3]) const {
    ray.place(depth, share);
    for (int a = 0; a < 3; ++a) share[a] = std::min(std::max(share[a] - origin[a], 0.0f), 1.0f);
  }

  // Mixes with shares that are not negative: where all corners are positive, so is the field.
  float at(const Ray& ray, float depth) const {
    float s[3], x[4];
    inside(ray, depth, s);
    for (int c = 0; c < 4; ++c) x[c] = (1 - s[0]) * value[2 * c] + s[0] * value[2 * c + 1];
    const float low = (1 - s[1]) * x[0] + s[1] * x[1], high = (1 - s[1]) * x[2] + s[1] * x[3];
    return (1 - s[2]) * low + s[2] * high;
  }

  // Depth of the surface between two, the field being negative at the second only.
  float crossing(const Ray& ray, float a, float at_a, float b, float at_b) const {
    float middle = a + (b - a) * at_a / (at_a - at_b);
    for (int i = 0; i < kMostSteps; ++i) {
      const float f = at(ray, middle);
      if (std::fabs(f) < kCloseEnough) break;
      if (f >= 0)
        a = middle, at_a = f;
      else
        b = middle, at_b = f;
      middle = a + (b - a) * at_a / (at_a - at_b);
    }
    return middle;
  }

  void gradient(const float s[3], float out[3]) const {
    for (int a = 0; a < 3; ++a) {
      const int b = (a + 1) % 3, c = (a + 2) % 3;
      out[a] = 0;
      for (int n = 0; n < 4; ++n) {
        const int low = (n & 1) << b | (n >> 1) << c;
        const float share = (n & 1 ? s[b] : 1 - s[b]) * (n >> 1 ? s[c] : 1 - s[c]);
        out[a] += share * (value[low | 1 << a] - value[low]);
      }
    }
  }
};

struct Hit {
  const SurfaceBlock* block = nullptr;
  int cell[3];
  float depth;
};

// A grid that a ray walks through: where it stands, and the depths at which it crosses the next planes of the grid.
// Plain numbers, not arrays, so that the compiler keeps them in registers.
struct Steps {
  float next_x, next_y, next_z;
  const float stride_x, stride_y, stride_z;
  int x, y, z;
  const int step_x, step_y, step_z;

  // From the cell of the grid at `start` (lowest corner, in voxels; cells of `size` voxels).
  Steps(const Ray& ray, const int start[3], int size)
      : next_x(boundary(ray, 0, start, size)), next_y(boundary(ray, 1, start, size)),
        next_z(boundary(ray, 2, start, size)), stride_x(size * std::fabs(ray.inverse[0])),
        stride_y(size * std::fabs(ray.inverse[1])), stride_z(size * std::fabs(ray.inverse[2])), x(start[0]),
        y(start[1]), z(start[2]), step_x(size * ray.step[0]), step_y(size * ray.step[1]), step_z(size * ray.step[2]) {}

  // Crosses the nearest plane (all of them, where they meet); returns the depth. Without branches: which axis is next
  // cannot be foretold.
  float advance() {
    const float depth = std::min(next_x, std::min(next_y, next_z));
    const int on_x = -(next_x <= depth), on_y = -(next_y <= depth), on_z = -(next_z <= depth);
    x += step_x & on_x, y += step_y & on_y, z += step_z & on_z;
    next_x += next_x <= depth ? stride_x : 0.0f;
    next_y += next_y <= depth ? stride_y : 0.0f;
    next_z += next_z <= depth ? stride_z : 0.0f;
    return depth;
  }

 private:
  // Depth at which the ray leaves a cell along an axis.
  static float boundary(const Ray& ray, int axis, const int start[3], int size) {
    const int end = start[axis] + (ray.step[axis] > 0 ? size : 0);
    return (static_cast<float>(end) - ray.origin[axis]) * ray.inverse[axis];
  }
};

class Walk {
 public:
  Walk(const RaycastScene& scene, const Ray& ray) : scene_(scene), ray_(ray) {}

  Hit run(float from, float to) {
    float here[3];
    int start[3];
    ray_.place(from, here);
    for (int a = 0; a < 3; ++a) start[a] = static_cast<int>(std::floor(here[a])) & ~(kSide - 1);
    Steps steps(ray_, start, kSide);
    Hit hit;
    for (float depth = from; depth < to; depth = steps.advance()) {
      const SurfaceBlock* block = find(steps.x >> 3, steps.y >> 3, steps.z >> 3);
      if (block == nullptr)
        known_ = false;
      else if (cells(*block, depth, hit))
        break;
    }
    return hit;
  }

 private:
  const RaycastScene& scene_;
  const Ray& ray_;
  bool known_ = false;  // whether `last_` is the field where the ray stands
  float last_ = 0;

  const SurfaceBlock* find(int x, int y, int z) const {
    for (uint32_t p = surface_hash(x, y, z);; ++p) {
      const int32_t number = scene_.table[p & scene_.table_mask];
      if (number < 0) return nullptr;
      const SurfaceBlock& block = scene_.blocks[number];
      if (block.at.x == x && block.at.y == y && block.at.z == z) return &block;
    }
  }

  // From cell to cell of a block; true where the ray meets the surface from its free side.
  bool cells(const SurfaceBlock& block, float depth, Hit& hit) {
    const int low[3] = {kSide * block.at.x, kSide * block.at.y, kSide * block.at.z};
    float here[3];
    int start[3];
    ray_.place(depth, here);
    for (int a = 0; a < 3; ++a)
      start[a] = std::clamp(static_cast<int>(std::floor(here[a])), low[a], low[a] + kSide - 1);
    Steps steps(ray_, start, 1);
    for (;;) {
      const int x = steps.x - low[0], y = steps.y - low[1], z = steps.z - low[2];
      if (static_cast<unsigned>(x | y | z) >= kSide) return false;
      const float leaves = steps.advance();
      if ((block.cells.word[z] >> (x + 8 * y) & 1) == 0) {
        known_ = false;
      } else {
        hit.cell[0] = x, hit.cell[1] = y, hit.cell[2] = z;
        const CellField field(block, hit.cell);
        // A ray from a cell without surface enters at a face whose corners are all outside, so that less than 0 can
        // only be the rounding of a 0; or it comes from the unknown.
        const float entry = known_ ? last_ : field.at(ray_, depth), after = field.at(ray_, leaves);
        const float before = !known_ && entry > -kCloseEnough ? std::max(entry, 0.0f) : entry;
        if (before >= 0 && after < 0) {
          hit.block = &block, hit.depth = field.crossing(ray_, depth, before, leaves, after);
          return true;
        }
        known_ = true, last_ = after;
      }
      depth = leaves;
    }
  }
};

void describe(const Ray& ray, const Hit& hit, const RaycastView& view, int64_t pixel, const SurfaceImages& out) {
  const CellField field(*hit.block, hit.cell);
  float share[3], gradient[3];
  field.inside(ray, hit.depth, share);
  field.gradient(share, gradient);
  const float scale = 1 / std::sqrt(gradient[0] * gradient[0] + gradient[1] * gradient[1] + gradient[2] * gradient[2]);
  const float* R = view.rotation;
  float* normal = out.normals + 3 * pixel;
  for (int a = 0; a < 3; ++a) {
    normal[a] = 0;
    for (int b = 0; b < 3; ++b) normal[a] += R[3 * b + a] * gradient[b] * scale;
  }
  const Corners at(*hit.block, hit.cell);
  float color[3] = {0, 0, 0}, colored = 0, nearest = -1;
  uint16_t label = 0;
  for (int c = 0; c < 8; ++c) {
    const VoxelBlock& v = *at.voxels[c];
    const int row = at.row[c], red = v.red[row], green = v.green[row], blue = v.blue[row];
    const float w = (c & 1 ? share[0] : 1 - share[0]) * (c & 2 ? share[1] : 1 - share[1]) *
                    (c & 4 ? share[2] : 1 - share[2]);
    const bool better = (v.label[row] != 0) & (w > nearest);
    nearest = better ? w : nearest, label = better ? v.label[row] : label;
    color[0] += w * red, color[1] += w * green, color[2] += w * blue;
    colored += (red | green | blue) != 0 ? w : 0.0f;  // black: has none
  }
  const float lift = colored > 0 ? 1 / colored : 0;
  for (int a = 0; a < 3; ++a) out.colors[3 * pixel + a] = static_cast<uint8_t>(color[a] * lift + 0.5f);
  out.labels[pixel] = label;
  out.depth[pixel] = hit.depth;
}

Ray ray_through(const RaycastView& view, int u, int v, float voxel) {
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

}  // namespace

void raycast_tile(const RaycastScene& scene, const RaycastView& view, const RaycastTile& tile,
                  const SurfaceImages& out) {
  for (int v = tile.top; v < tile.bottom; ++v)
    for (int u = tile.left; u < tile.right; ++u) {
      const int64_t pixel = static_cast<int64_t>(v) * view.width + u;
      const Ray ray = ray_through(view, u, v, scene.voxel);
      const Hit hit = Walk(scene, ray).run(tile.from, tile.to);
      if (hit.block != nullptr && hit.depth >= view.near && hit.depth <= view.far)
        describe(ray, hit, view, pixel, out);
    }
}

}  // namespace ggslam::GGSLAM_ISA
