// SPDX-License-Identifier: Apache-2.0
#include "volumes/tsdf_rays.hpp"

#include <cmath>
#include <limits>

#include "common/context.hpp"
#include "volumes/tsdf_listed_blocks.hpp"

namespace ggslam::volumes {
namespace {

// What all rays of a view have in common; lengths in voxels from the first voxel of the corner's block.
struct View {
  Mat3d axes;       // of the camera in the map
  Vec3d position;   // of the camera
  Vec3i corner;     // block
  Vec3d depth_row;  // depth of a place: its scalar product with this, plus `depth_offset`, voxels
  double depth_offset;
  double truncation, radius;  // voxels; the radius of the rays that tell a voxel something
};

View view_of(const Tsdf& map, const FusionInput& in) {
  View view;
  view.axes = Mat3d::from(in.rotation).transpose();
  const Vec3d position = (-1.0 / map.voxel) * (view.axes * Vec3d::from(in.translation));
  view.corner = floor((1.0 / kSide) * position);
  view.position = position - static_cast<double>(kSide) * cast<double>(view.corner);
  view.depth_row = view.axes.column(2);
  view.depth_offset = -dot(view.depth_row, view.position);
  view.truncation = map.truncation / map.voxel, view.radius = kRayRadius / map.voxel;
  return view;
}

// Walks over the voxels between two depths of a ray.
class Walk {
 public:
  // `way`: voxels along the map's axes for one of depth.
  Walk(const View& view, const Vec3d& way, double from, double to) : to_(to) {
    for (int a = 0; a < 3; ++a) {
      const double start = view.position[a] + from * way[a];
      at_[a] = static_cast<int32_t>(std::floor(start));
      sign_[a] = way[a] > 0 ? 1 : -1;
      const double border = at_[a] + (way[a] > 0 ? 1.0 : 0.0);
      const bool level = std::fabs(way[a]) < 1e-12;
      next_[a] = level ? std::numeric_limits<double>::max() : from + (border - start) / way[a];
      step_[a] = level ? 0.0 : std::fabs(1.0 / way[a]);
    }
  }
  const int32_t* voxel() const { return at_; }
  // False at the end.
  bool advance() {
    const int a = next_[0] < next_[1] ? (next_[0] < next_[2] ? 0 : 2) : (next_[1] < next_[2] ? 1 : 2);
    if (next_[a] > to_) return false;
    at_[a] += sign_[a], next_[a] += step_[a];
    return true;
  }

 private:
  double to_, next_[3], step_[3];
  int32_t at_[3], sign_[3];
};

// Adds what a ray measures to the voxels that it passes; `depth` in voxels.
void cast_ray(const View& view, const Vec3d& way, double depth, ListedBlocks& blocks, FusionScratch& scratch) {
  const double unit = RaySum::kUnits / view.truncation;
  Walk walk(view, way, std::max(0.0, depth - view.truncation), depth + view.truncation);
  do {
    const int32_t* const at = walk.voxel();
    const int32_t n = blocks.find(at[0] >> 3, at[1] >> 3, at[2] >> 3);
    if (n < 0) continue;
    const Vec3d centre = {{at[0] + 0.5, at[1] + 0.5, at[2] + 0.5}};
    const double z = dot(view.depth_row, centre) + view.depth_offset, distance = depth - z;
    if (std::fabs(distance) > view.truncation) continue;
    const Vec3d offset = view.position + z * way - centre;
    if (dot(offset, offset) > view.radius * view.radius) continue;
    RaySum& sum = scratch.rays[static_cast<std::size_t>(n) * kVoxels + (at[0] & 7) + kSide * (at[1] & 7) +
                               kSide * kSide * (at[2] & 7)];
    __atomic_fetch_add(&sum.distance, static_cast<int32_t>(std::lround(unit * distance)), __ATOMIC_RELAXED);
    __atomic_fetch_add(&sum.count, 1, __ATOMIC_RELAXED);
    __atomic_store_n(&scratch.passed[n], 1, __ATOMIC_RELAXED);
  } while (walk.advance());
}

}  // namespace

void cast_rays(const Tsdf& map, const FusionInput& in, const FusionSettings& settings, Context& context,
               FusionScratch& scratch) {
  scratch.rays.resize(std::max(scratch.rays.size(), scratch.updates.size() * kVoxels));
  scratch.passed.assign(scratch.updates.size(), 0);
  const ListedRows rows(map, scratch);
  const View view = view_of(map, in);
  context.pool.parallel_for(in.height, 8, [&](std::size_t begin, std::size_t end, int) {
    ListedBlocks blocks(map, scratch, view.corner);
    for (std::size_t v = begin; v < end; ++v) {
      const float* const depth = scratch.images.depth.data() + v * in.width;
      for (int u = 0; u < in.width; ++u) {
        if (!(depth[u] > 0) || depth[u] > settings.max_depth) continue;
        const Vec3d ray = {{(u - in.cx) / in.fx, (static_cast<double>(v) - in.cy) / in.fy, 1.0}};
        cast_ray(view, view.axes * ray, depth[u] / static_cast<double>(map.voxel), blocks, scratch);
      }
    }
  });
}

}  // namespace ggslam::volumes
