// SPDX-License-Identifier: Apache-2.0
// The vertex where the surface cuts an edge between two neighbouring voxels.
#pragma once
#include <cstdint>

#include "volumes/surface_cells.hpp"

namespace ggslam::volumes {

class EdgeVertex {
 public:
  // The edge from voxel (i, j, k) of a block along an axis; its ends are on different sides of the surface.
  EdgeVertex(const SurfaceBlock& block, uint16_t min_weight, int axis, int i, int j, int k);

  void position(float voxel, float out[3]) const;
  // Gradient of the field: along the edge between its ends, across it between the voxels beside them.
  void normal(float out[3]) const;
  // Mixed from both ends; black stands for none.
  void color(uint8_t out[3]) const;
  // Of the end nearer to the surface; the other's if that one has none.
  uint16_t label() const;

 private:
  struct Voxel {
    const VoxelBlock* block;
    int row;
    int value() const { return block->value[row]; }
  };

  const SurfaceBlock& block_;
  uint16_t min_weight_;
  int axis_;
  Vec3i at_;
  Voxel ends_[2];
  float share_;  // of the way from the first end to the other

  Voxel voxel(const Vec3i& at) const;
  bool beside(int axis, int step, float& value) const;
};

}  // namespace ggslam::volumes
