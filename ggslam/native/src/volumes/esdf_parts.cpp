// SPDX-License-Identifier: Apache-2.0
// A distance field that was made elsewhere, by the CUDA kernels, becomes one that is updated here.
#include <algorithm>
#include <cmath>

#include "volumes/esdf.hpp"

namespace ggslam::volumes {
namespace {

void take_sites(const FieldParts& parts, int64_t first, int64_t end, std::vector<Site>& out) {
  for (int64_t s = first; s < end; ++s) {
    Site site{};
    std::copy_n(parts.site_at + 3 * s, 3, site.at);
    std::copy_n(parts.site_normal + 3 * s, 3, site.normal);
    site.radius = parts.site_radius[s], site.voxel = parts.site_voxel[s];
    out.push_back(site);
  }
}

// The slots that a block's voxels have owners in, and how far they are from these at most, metres.
float list_owners(FieldBlock& block) {
  float farthest = 0;
  for (int v = 0; v < kVoxels; ++v) {
    const float distance = std::fabs(block.voxels->distance[v]);
    if (distance > farthest) farthest = distance;
    const uint32_t owner = block.voxels->owner[v];
    if (owner == kNobody) continue;
    if (std::find(block.owners.begin(), block.owners.end(), owner / kVoxels) == block.owners.end())
      block.owners.push_back(owner / kVoxels);
  }
  return farthest;
}

}  // namespace

void Esdf::take(const FieldParts& parts) {
  clear();
  int64_t site = 0;
  for (int64_t b = 0; b < parts.blocks; ++b) {
    FieldBlock& block = insert({parts.at[3 * b], parts.at[3 * b + 1], parts.at[3 * b + 2]});
    std::copy_n(parts.known + kSide * b, kSide, block.known);
    std::copy_n(parts.negative + kSide * b, kSide, block.negative);
    std::copy_n(parts.crossed + kSide * b, kSide, block.crossed);
    std::copy_n(block.known, kSide, block.done_known);
    std::copy_n(block.negative, kSide, block.done_negative);
    const int64_t first = site;
    while (site < parts.sites && parts.site_block[site] == b) ++site;
    take_sites(parts, first, site, block.sites);
    make_leaves(block.sites, kMostInLeaf, slack_, block.tree);
    block.voxels = std::make_unique<FieldVoxels>();
    std::copy_n(parts.distance + kVoxels * b, kVoxels, block.voxels->distance);
    std::copy_n(parts.gradient + kVoxels * b, kVoxels, block.voxels->gradient);
    std::copy_n(parts.owner + kVoxels * b, kVoxels, block.voxels->owner);  // the slots are the blocks' numbers
    block.farthest = list_owners(block) / tsdf_.voxel * 1.0001f;
    block.anew = false;
  }
  revision_ = tsdf_.revision;
}

}  // namespace ggslam::volumes
