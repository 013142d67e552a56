// SPDX-License-Identifier: Apache-2.0
#include "volumes/edge_vertex.hpp"

#include <algorithm>

#include "common/vector.hpp"

namespace ggslam::volumes {
namespace {

// Vertices keep this far from the ends of their edges: where a voxel lies on the surface, the vertices of its edges
// do not fall together, and no triangle is without area.
constexpr float kMargin = 1.0f / 128;

}  // namespace

EdgeVertex::EdgeVertex(const SurfaceBlock& block, uint16_t min_weight, int axis, int i, int j, int k)
    : block_(block), min_weight_(min_weight), axis_(axis), at_{{i, j, k}} {
  ends_[0] = voxel(at_), ends_[1] = voxel(at_ + Vec3i{{axis == 0, axis == 1, axis == 2}});
  const float a = static_cast<float>(ends_[0].value()), b = static_cast<float>(ends_[1].value());
  share_ = std::min(std::max(a / (a - b), kMargin), 1 - kMargin);
}

// A voxel of the block or of those around it.
EdgeVertex::Voxel EdgeVertex::voxel(const Vec3i& at) const {
  const VoxelBlock* owner = block_.voxels[around_index(at[0] >> 3, at[1] >> 3, at[2] >> 3)];
  return {owner, (at[0] & 7) + 8 * (at[1] & 7) + 64 * (at[2] & 7)};
}

void EdgeVertex::position(float voxel, float out[3]) const {
  Vec3f p = cast<float>(kSide * vector_of(block_.at) + at_) + Vec3f::all(0.5f);
  p[axis_] += share_;
  (voxel * p).to(out);
}

// The field beside the vertex, `step` voxels along an axis across the edge; false where it is not known.
bool EdgeVertex::beside(int axis, int step, float& value) const {
  Vec3i at = at_;
  at[axis] += step;
  const Voxel a = voxel(at);
  ++at[axis_];
  const Voxel b = voxel(at);
  if (a.block->weight[a.row] < min_weight_ || b.block->weight[b.row] < min_weight_) return false;
  value = (1 - share_) * a.value() + share_ * b.value();
  return true;
}

void EdgeVertex::normal(float out[3]) const {
  Vec3f slope;
  for (int a = 0; a < 3; ++a) {
    if (a == axis_) {
      slope[a] = static_cast<float>(ends_[1].value() - ends_[0].value());
      continue;
    }
    float low = 0, high = 0;  // the vertex itself is at 0
    const int sides = beside(a, -1, low) + beside(a, 1, high);
    slope[a] = sides == 0 ? 0 : (high - low) / sides;
  }
  normalize(slope).to(out);
}

void EdgeVertex::color(uint8_t out[3]) const {
  Vec3f color[2];
  float share[2] = {1 - share_, share_};
  for (int e = 0; e < 2; ++e) {
    const VoxelBlock& b = *ends_[e].block;
    const int row = ends_[e].row;
    color[e] = cast<float>(Vec3<uint8_t>{{b.red[row], b.green[row], b.blue[row]}});
    if (b.red[row] == 0 && b.green[row] == 0 && b.blue[row] == 0) share[e] = 0;
  }
  const float scale = share[0] + share[1] > 0 ? 1 / (share[0] + share[1]) : 0;
  const Vec3f mixed = scale * (share[0] * color[0] + share[1] * color[1]);
  cast<uint8_t>(mixed + Vec3f::all(0.5f)).to(out);
}

uint16_t EdgeVertex::label() const {
  const int nearer = share_ <= 0.5f ? 0 : 1;
  const uint16_t label = ends_[nearer].block->label[ends_[nearer].row];
  return label != 0 ? label : ends_[1 - nearer].block->label[ends_[1 - nearer].row];
}

}  // namespace ggslam::volumes
