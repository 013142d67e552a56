// SPDX-License-Identifier: Apache-2.0
#include "volumes/raycast.hpp"

#include <algorithm>
#include <cmath>

#include "common/context.hpp"
#include "common/guard.hpp"
#include "common/vector.hpp"

GGSLAM_DECLARE_KERNEL(void raycast_tile(const volumes::RaycastScene& scene, const volumes::RaycastView& view,
                                        const volumes::RaycastTile& tile, const volumes::SurfaceImages& out))

namespace ggslam::volumes {
namespace {

constexpr int kTile = 8;
constexpr int kPart = kSide / 2;  // boxes of so many cells are projected

// Depth range of the boxes with surface that may be seen through each tile of the image (the idea is that of V.
// Prisacariu et al., "InfiniTAM", 2014).
class TileRanges {
 public:
  TileRanges(const SurfaceCells& cells, const RaycastView& view)
      : columns_((view.width + kTile - 1) / kTile), rows_((view.height + kTile - 1) / kTile), view_(view),
        voxel_(cells.map.voxel) {
    tiles_.resize(static_cast<std::size_t>(columns_) * rows_);
    for (int r = 0; r < rows_; ++r)
      for (int c = 0; c < columns_; ++c)
        tiles_[r * columns_ + c] = {c * kTile, r * kTile, std::min((c + 1) * kTile, view.width),
                                    std::min((r + 1) * kTile, view.height), view.far, view.near};
    for (const SurfaceBlock& block : cells.blocks) add(block);
  }

  const std::vector<RaycastTile>& tiles() const { return tiles_; }

 private:
  const int columns_, rows_;
  const RaycastView& view_;
  const float voxel_;
  std::vector<RaycastTile> tiles_;

  void add(const SurfaceBlock& block) {
    for (int z = 0; z < kSide; z += kPart) {
      uint64_t layers = 0;
      for (int k = 0; k < kPart; ++k) layers |= block.cells.word[z + k];
      for (int y = 0; y < kSide; y += kPart)
        for (int x = 0; x < kSide; x += kPart)
          if ((layers >> (x + 8 * y)) & 0x0F0F0F0Full)
            add_box(kSide * block.at.x + x, kSide * block.at.y + y, kSide * block.at.z + z);
    }
  }

  // The box of kPart^3 cells from a voxel.
  void add_box(int x, int y, int z) {
    const Vec3f low_corner{{voxel_ * (x + 0.5f), voxel_ * (y + 0.5f), voxel_ * (z + 0.5f)}};
    const Mat3f to_camera = Mat3f::from(view_.rotation).transpose();
    const Vec3f first = to_camera * (low_corner - Vec3f::from(view_.position));
    int beyond[4] = {0, 0, 0, 0};  // corners beyond the planes through the camera and the image's sides
    Vec3f low = Vec3f::all(1e30f), high = Vec3f::all(-1e30f);  // column, row, depth
    for (int c = 0; c < 8; ++c) {
      const Vec3f step{{static_cast<float>(c & 1), static_cast<float>((c >> 1) & 1), static_cast<float>(c >> 2)}};
      const Vec3f p = first + kPart * voxel_ * (to_camera * step);
      const float u = view_.fx * p[0] + view_.cx * p[2], v = view_.fy * p[1] + view_.cy * p[2];
      beyond[0] += u < -p[2], beyond[1] += u > view_.width * p[2];
      beyond[2] += v < -p[2], beyond[3] += v > view_.height * p[2];
      // Beside the camera the projection is of no use: the box may be anywhere in the image.
      const float inverse = 1 / std::max(p[2], 1e-6f);
      const Vec3f seen{{u * inverse, v * inverse, p[2]}};
      low = min(low, seen), high = max(high, seen);
    }
    if (high[2] < view_.near || low[2] > view_.far || *std::max_element(beyond, beyond + 4) == 8) return;
    const bool beside = low[2] <= 0;
    const int left = beside ? 0 : tile_of(low[0], columns_), right = beside ? columns_ - 1 : tile_of(high[0], columns_);
    const int top = beside ? 0 : tile_of(low[1], rows_), bottom = beside ? rows_ - 1 : tile_of(high[1], rows_);
    for (int r = top; r <= bottom; ++r)
      for (int c = left; c <= right; ++c) {
        RaycastTile& tile = tiles_[r * columns_ + c];
        tile.from = std::max(std::min(tile.from, low[2] - kMargin * voxel_), view_.near);
        tile.to = std::min(std::max(tile.to, high[2] + kMargin * voxel_), view_.far);
      }
  }

  static constexpr float kMargin = 0.01f;  // for rounding, voxels
  static int tile_of(float pixel, int tiles) {
    return std::clamp(static_cast<int>(std::floor(std::clamp(pixel, -1e6f, 1e6f) / kTile)), 0, tiles - 1);
  }
};

}  // namespace
}  // namespace ggslam::volumes

GGSLAM_EXPORT int ggslam_raycast(void* context_, void* cells_, const ggslam::volumes::RaycastView* view,
                                 const ggslam::volumes::SurfaceImages* out) try {
  using namespace ggslam;
  using namespace ggslam::volumes;
  ggslam::Context& context = object_of<ggslam::Context>(context_);
  const SurfaceCells& cells = object_of<SurfaceCells>(cells_);
  const auto kernel = GGSLAM_DISPATCH(context.isa, raycast_tile);
  const RaycastView& v = object_of<RaycastView>(view);
  check_camera(v.width, v.height, v.fx, v.fy, v.cx, v.cy);
  check_range("near", v.near, 1e-6f, 1e9f), check_range("far", v.far, v.near, 1e9f);
  check_within("rotation", v.rotation, 9, 2);
  check_within("position", v.position, 3, 1.0 * kSide * kFarthestBlock * cells.map.voxel);
  const SurfaceImages& images = object_of<SurfaceImages>(out);
  const void* const arrays[] = {images.depth, images.normals, images.colors, images.labels};
  for (const void* array : arrays) check_array("images", array, 1);
  const TileRanges ranges(cells, *view);
  const RaycastScene scene{cells.blocks.data(), cells.table.number.data(),
                           static_cast<uint32_t>(cells.table.number.size() - 1), cells.map.voxel};
  context.pool.parallel_for(ranges.tiles().size(), 16, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t t = begin; t < end; ++t) kernel(scene, *view, ranges.tiles()[t], *out);
  });
  return 0;
} GGSLAM_CATCH_ALL
