// SPDX-License-Identifier: Apache-2.0
// Which blocks of the distance field an update concerns: those with voxels whose site went or moved, that sites came near
// enough to, or of which other voxels are known.
#include <algorithm>
#include <cmath>
#include <cstring>

#include "volumes/esdf.hpp"

GGSLAM_DECLARE_KERNEL(int esdf_near(const ggslam::volumes::NodeColumns& nodes, const float middle[3], float reach,
                                    float most, float* scratch, int32_t* out))

namespace ggslam::volumes {
namespace {

constexpr int kRegion = 4;  // blocks along an edge
constexpr float kRegionMiddle = 0.5f * (kRegion * kSide - 1), kRegionReach = 1.7321f * kRegionMiddle;

BlockCoordinates region_at(BlockCoordinates at) {
  return {at.x >> 2, at.y >> 2, at.z >> 2};
}

bool same_words(const uint64_t* a, const uint64_t* b) { return std::memcmp(a, b, kSide * sizeof *a) == 0; }

// The groups that may matter to a region with no voxel farther from its site than `most`, from its first voxel.
void list_near(Context& context, const NodeTable& nodes, const Region& region, float most, NodeTable& out) {
  std::vector<float> least(nodes.count() + 16);
  std::vector<int32_t> found(nodes.count());
  NodeColumns columns = nodes.columns();
  columns.origin = region.at;
  const float middle[3] = {kRegionMiddle, kRegionMiddle, kRegionMiddle};
  const auto kernel = GGSLAM_DISPATCH(context.isa, esdf_near);
  const int n = kernel(columns, middle, kRegionReach, most, least.data(), found.data());
  out.clear(n);
  for (int i = 0; i < n; ++i) {
    const Vec3f shift = cast<float>(kSide * (vector_of(nodes.at(found[i])) - vector_of(region.at)));
    out.add(nodes, found[i], shift.v);
  }
}

}  // namespace

// The middle of a block, from the first voxel of its region.
Vec3f middle_in(const FieldBlock& block, const Region& region) {
  return cast<float>(kSide * (vector_of(block.at) - vector_of(region.at))) + Vec3f::all(0.5f * (kSide - 1));
}

// All sites in groups, and those that came or moved.
void Esdf::list_groups() {
  groups_.clear(), arrivals_.clear();
  const auto add = [](const FieldBlock& block, const SiteLeaves& leaves, std::vector<SiteGroup>& to) {
    int32_t begin = 0;
    for (const Leaf& leaf : leaves.leaves) {
      to.push_back({&leaf.node, leaves.sites.data() + begin, leaves.columns.data() + begin, leaves.stride,
                    leaf.end - begin, block.at, block.slot * static_cast<uint32_t>(kVoxels)});
      begin = leaf.end;
    }
  };
  for (const auto& block : blocks_) add(*block, block->tree, groups_), add(*block, block->arrived, arrivals_);
  const auto fill = [](const std::vector<SiteGroup>& groups, NodeTable& nodes) {
    nodes.clear(groups.size());
    for (std::size_t g = 0; g < groups.size(); ++g) nodes.add(*groups[g].node, groups[g].at, static_cast<int32_t>(g));
  };
  fill(groups_, group_nodes_), fill(arrivals_, arrival_nodes_);
  touched_.resize(slots_.size());
  for (std::size_t slot = 0; slot < slots_.size(); ++slot) touched_[slot] = slots_[slot] && slots_[slot]->touched;
  lists_.resize(slots_.size());
  for (std::size_t slot = 0; slot < slots_.size(); ++slot) {
    const FieldBlock* block = slots_[slot];
    lists_[slot] = {};
    if (block) lists_[slot] = {block->sites.data(), static_cast<int32_t>(block->sites.size()), block->at};
  }
}

// Puts the blocks into regions, with the groups that came near them.
void Esdf::divide(Context& context) {
  BlockTable places;
  regions_.clear();
  region_of_.resize(blocks_.size());
  for (std::size_t row = 0; row < blocks_.size(); ++row) {
    const BlockCoordinates at = region_at(blocks_[row]->at);
    const std::size_t q = places.insert(at);
    if (q == regions_.size()) regions_.push_back({{at.x * kRegion, at.y * kRegion, at.z * kRegion}, {}, {}, 0});
    region_of_[row] = static_cast<int32_t>(q);
    if (!blocks_[row]->anew) regions_[q].farthest = std::max(regions_[q].farthest, blocks_[row]->farthest);
  }
  context.pool.parallel_for(regions_.size(), 8, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t q = begin; q < end; ++q)
      list_near(context, arrival_nodes_, regions_[q], regions_[q].farthest, regions_[q].arrived);
  });
}

int NearSearch::find(Context& context, const NodeTable& nodes, const float middle[3], float reach, float most) {
  least_.resize(nodes.count() + 16), found_.resize(nodes.count());
  const auto kernel = GGSLAM_DISPATCH(context.isa, esdf_near);
  return kernel(nodes.columns(), middle, reach, most, least_.data(), found_.data());
}

void NearSearch::list(Context& context, const NodeTable& nodes, const float middle[3], float reach, float most,
                      const float shift[3], NodeTable& out) {
  const int n = find(context, nodes, middle, reach, most);
  out.clear(n);
  for (int i = 0; i < n; ++i) out.add(nodes, found_[i], shift);
}

// Whether something may be different in a block.
bool Esdf::concerns(Context& context, const FieldBlock& block, const Region& region,
                    NearSearch& search) const {
  if (block.anew || block.waits > 0 || !same_words(block.known, block.done_known) || !same_words(block.negative, block.done_negative))
    return true;
  for (const uint32_t slot : block.owners)
    if (touched_[slot]) return true;
  float middle[3];
  middle_in(block, region).to(middle);
  return search.find(context, region.arrived, middle, kBlockReach, block.farthest) > 0;
}

std::vector<int32_t> Esdf::select(Context& context) {
  list_groups();
  divide(context);
  std::vector<uint8_t> concerned(blocks_.size(), 0);
  context.pool.parallel_for(blocks_.size(), 64, [&](std::size_t begin, std::size_t end, int) {
    NearSearch search;
    for (std::size_t row = begin; row < end; ++row)
      concerned[row] = concerns(context, *blocks_[row], regions_[region_of_[row]], search);
  });
  std::vector<int32_t> rows;
  std::vector<uint8_t> wanted(regions_.size(), 0);
  for (std::size_t row = 0; row < blocks_.size(); ++row)
    if (concerned[row]) rows.push_back(static_cast<int32_t>(row)), wanted[region_of_[row]] = 1;
  context.pool.parallel_for(regions_.size(), 8, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t q = begin; q < end; ++q)
      if (wanted[q]) list_near(context, group_nodes_, regions_[q], max_distance_, regions_[q].all);
  });
  return rows;
}

}  // namespace ggslam::volumes
