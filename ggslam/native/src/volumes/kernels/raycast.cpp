// SPDX-License-Identifier: Apache-2.0
// Rays walk through blocks that hold surface, and in them from cell to cell (J. Amanatides and A. Woo, "A Fast Voxel
// Traversal Algorithm for Ray Tracing", 1987). In a cell with surface the field along the ray is followed exactly.
#include "volumes/raycast.hpp"

#include <algorithm>
#include <cmath>

#include "native/formulas/ray_cells.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

using namespace volumes;

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

CellField cell_field(const SurfaceBlock& block, const int cell[3]) {
  CellField field;
  if (cell[0] < 7 && cell[1] < 7 && cell[2] < 7) {
    const int16_t* v = block.voxels[kHere]->value + cell[0] + 8 * cell[1] + 64 * cell[2];
    for (int c = 0; c < 8; ++c) field.value[c] = v[(c & 1) + 8 * ((c >> 1) & 1) + 64 * (c >> 2)];
  } else {
    const Corners at(block, cell);
    for (int c = 0; c < 8; ++c) field.value[c] = at.voxels[c]->value[at.row[c]];
  }
  const int32_t first[3] = {block.at.x, block.at.y, block.at.z};
  for (int a = 0; a < 3; ++a) field.origin[a] = static_cast<float>(kSide * first[a] + cell[a]);
  return field;
}

struct Hit {
  const SurfaceBlock* block = nullptr;
  int cell[3];
  float depth;
};

class Walk {
 public:
  Walk(const RaycastScene& scene, const Ray& ray) : scene_(scene), ray_(ray) {}

  Hit run(float from, float to) {
    float here[3];
    int start[3];
    place_on(ray_, from, here);
    for (int a = 0; a < 3; ++a) start[a] = static_cast<int>(std::floor(here[a])) & ~(kSide - 1);
    RaySteps steps = steps_from(ray_, start, kSide);
    Hit hit;
    for (float depth = from; depth < to; depth = advance_ray(steps)) {
      const SurfaceBlock* block = find(steps.x >> 3, steps.y >> 3, steps.z >> 3);
      if (block == nullptr)
        knows_.known = false;
      else if (cells(*block, depth, hit))
        break;
    }
    return hit;
  }

 private:
  const RaycastScene& scene_;
  const Ray& ray_;
  RayKnowledge knows_{false, 0};

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
    place_on(ray_, depth, here);
    for (int a = 0; a < 3; ++a)
      start[a] = std::clamp(static_cast<int>(std::floor(here[a])), low[a], low[a] + kSide - 1);
    RaySteps steps = steps_from(ray_, start, 1);
    for (;;) {
      const int x = steps.x - low[0], y = steps.y - low[1], z = steps.z - low[2];
      if (static_cast<unsigned>(x | y | z) >= kSide) return false;
      const float leaves = advance_ray(steps);
      if ((block.cells.word[z] >> (x + 8 * y) & 1) == 0) {
        knows_.known = false;
      } else {
        hit.cell[0] = x, hit.cell[1] = y, hit.cell[2] = z;
        if (meets_surface(cell_field(block, hit.cell), ray_, depth, leaves, knows_, hit.depth)) {
          hit.block = &block;
          return true;
        }
      }
      depth = leaves;
    }
  }
};

void describe(const Ray& ray, const Hit& hit, const RaycastView& view, int64_t pixel, const SurfaceImages& out) {
  const CellField field = cell_field(*hit.block, hit.cell);
  float share[3], gradient[3];
  inside_cell(field, ray, hit.depth, share);
  cell_gradient(field, share, gradient);
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
