// SPDX-License-Identifier: Apache-2.0
// Which surface points came, went or moved since the last update of the distance field.
#include <algorithm>
#include <cmath>
#include <cstring>

#include "native/formulas/surface_sites.hpp"
#include "volumes/esdf.hpp"

GGSLAM_DECLARE_KERNEL(int esdf_crossings(const int16_t* values, ggslam::volumes::Site* out, uint64_t* known,
                                         uint64_t* negative, float unit))

namespace ggslam::volumes {
namespace {

constexpr BlockCoordinates kFaces[6] = {{-1, 0, 0}, {1, 0, 0}, {0, -1, 0}, {0, 1, 0}, {0, 0, -1}, {0, 0, 1}};

BlockCoordinates operator+(BlockCoordinates a, BlockCoordinates b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }

// A whole row of a block.
void copy_row(const int16_t* value, const uint16_t* weight, int16_t* to) {
  typedef int16_t Row __attribute__((vector_size(2 * kSide)));
  Row values, weights;
  std::memcpy(&values, value, sizeof values);
  std::memcpy(&weights, weight, sizeof weights);
  const Row least = Row{} - kFreeValue, unseen = Row{} + kUnseen;
  values = values < least ? least : values;
  values = weights == 0 ? unseen : values;
  std::memcpy(to, &values, sizeof values);
}

// Copies what a block has in a box (its own voxels, -1: the halo before it, 8: behind) out of one at `shift`.
void copy_values(const Tsdf& map, int64_t row, const Box3i& box, BlockCoordinates shift, int16_t* values) {
  if (row < 0) return;
  const Block& block = map.block(row);
  const VoxelBlock* from = map.voxels(block);
  if (from == nullptr && block.free_weight == 0) return;
  const int first = box.low[0], count = box.high[0] - box.low[0];
  for (int k = box.low[2]; k < box.high[2]; ++k)
    for (int j = box.low[1]; j < box.high[1]; ++j) {
      const int v = (first - kSide * shift.x) + (j - kSide * shift.y) * kSide + (k - kSide * shift.z) * kSide * kSide;
      int16_t* to = values + (first + 1) + (j + 1) * kHalo + (k + 1) * kHalo * kHalo;
      if (from == nullptr) std::fill_n(to, count, kFreeValue);
      else if (count == kSide) copy_row(from->value + v, from->weight + v, to);
      else
        for (int i = 0; i < count; ++i)
          to[i] = from->weight[v + i] == 0 ? kUnseen : std::max<int16_t>(from->value[v + i], -kFreeValue);
    }
}

// Takes over the sites of a block. One that hardly moved stays where it was: the rounding of values would move half of
// them with every view, and voxels without number with them. Returns how many came, went or moved.
int64_t take_sites(FieldBlock& block, std::vector<Site>& now, std::vector<Site>& came) {
  int64_t changed = 0;
  std::size_t b = 0;
  const auto lose = [&](const Site& site) {
    block.gone[site.voxel >> 6] |= uint64_t{1} << (site.voxel & 63);
    ++changed;
  };
  for (Site& site : now) {
    for (; b < block.sites.size() && block.sites[b].voxel < site.voxel; ++b) lose(block.sites[b]);
    if (b < block.sites.size() && block.sites[b].voxel == site.voxel) {
      const Site& held = block.sites[b++];
      if (plain::disc_shift(held.at, held.normal, held.radius, site.at, site.normal, site.radius) <= kHeld) {
        site = held;
        continue;
      }
      lose(held);
    } else {
      ++changed;
    }
    came.push_back(site);
  }
  for (; b < block.sites.size(); ++b) lose(block.sites[b]);
  if (changed > 0) block.sites = now;
  return changed;
}

// Of a block that has not changed.
BlockSites crossings_of(const FieldBlock& block) {
  BlockSites out;
  std::memcpy(out.known, block.known, sizeof out.known);
  std::memcpy(out.negative, block.negative, sizeof out.negative);
  for (const Site& site : block.sites)
    if (block.crossed[site.voxel >> 6] >> (site.voxel & 63) & 1) out.sites.push_back(site);
  return out;
}

}  // namespace

// Values of a block and the voxels at its faces, as esdf_crossings reads them.
void Esdf::gather(BlockCoordinates at, int16_t* values) const {
  std::fill_n(values, kHalo * kHalo * kHalo, kUnseen);
  const Box3i own{Vec3i::all(0), Vec3i::all(kSide)};
  copy_values(tsdf_, tsdf_.find(at), own, {0, 0, 0}, values);
  for (const BlockCoordinates& face : kFaces) {
    const Box3i halo = intersection(own.shift(kSide * vector_of(face)), own.grow(1));
    copy_values(tsdf_, tsdf_.find(at + face), halo, face, values);
  }
}

FieldBlock& Esdf::insert(BlockCoordinates at) {
  if (free_slots_.empty()) {
    free_slots_.push_back(static_cast<uint32_t>(slots_.size()));
    slots_.push_back(nullptr);
  }
  table_.insert(at);
  blocks_.push_back(std::make_unique<FieldBlock>());
  FieldBlock& block = *blocks_.back();
  block.at = at;
  block.slot = free_slots_.back();
  free_slots_.pop_back();
  slots_[block.slot] = &block;
  return block;
}

// Slots stay taken until the end of the update: voxels elsewhere have owners there.
void Esdf::erase_gone(FieldStats& stats, std::vector<BlockCoordinates>& touched) {
  for (std::size_t row = blocks_.size(); row-- > 0;) {
    const BlockCoordinates at = table_.at(row);
    if (tsdf_.find(at) >= 0) continue;
    touched.push_back(at);
    ++stats.changed_blocks;
    FieldBlock& block = *blocks_[row];
    std::vector<Site> none, came;
    stats.changed_sites += take_sites(block, none, came);
    block.touched = true;
    table_.erase(row);
    erased_.push_back(std::move(blocks_[row]));
    blocks_[row] = std::move(blocks_.back());
    blocks_.pop_back();
  }
}

// Zero crossings of blocks, and which of the blocks have others than before.
std::vector<int32_t> Esdf::find_crossings(Context& context, const std::vector<int32_t>& rows,
                                          std::vector<BlockSites>& found) {
  found.resize(rows.size());
  std::vector<uint8_t> differ(rows.size());
  const auto kernel = GGSLAM_DISPATCH(context.isa, esdf_crossings);
  const float unit = tsdf_.truncation / tsdf_.voxel / kFreeValue;
  context.pool.parallel_for(rows.size(), 16, [&](std::size_t begin, std::size_t end, int) {
    int16_t values[kHalo * kHalo * kHalo];
    std::vector<Site> sites(kVoxels + 1);
    for (std::size_t i = begin; i < end; ++i) {
      gather(table_.at(rows[i]), values);
      const int n = kernel(values, sites.data(), found[i].known, found[i].negative, unit);
      found[i].sites.assign(sites.begin(), sites.begin() + n);
      uint64_t crossed[kSide] = {};
      for (const Site& site : found[i].sites) crossed[site.voxel >> 6] |= uint64_t{1} << (site.voxel & 63);
      FieldBlock& block = *blocks_[rows[i]];
      differ[i] = std::memcmp(crossed, block.crossed, sizeof crossed) != 0;
      std::memcpy(block.crossed, crossed, sizeof crossed);
    }
  });
  std::vector<int32_t> changed;
  for (std::size_t i = 0; i < rows.size(); ++i)
    if (differ[i]) changed.push_back(rows[i]);
  return changed;
}

void Esdf::find_sites(Context& context, FieldStats& stats) {
  std::vector<BlockCoordinates> touched;
  for (std::size_t row = 0; row < tsdf_.size(); ++row) {
    const Block& block = tsdf_.block(row);
    const bool is_new = table_.find(block.at) < 0;
    if (!is_new && block.revision <= revision_) continue;
    if (is_new) insert(block.at);
    touched.push_back(block.at);
  }
  stats.changed_blocks = static_cast<int64_t>(touched.size());
  if (blocks_.size() > tsdf_.size()) erase_gone(stats, touched);
  // The sites of a block depend on the voxels at its faces, too.
  std::vector<int32_t> rows;
  std::vector<uint8_t> listed(blocks_.size(), 0);
  const auto list = [&](BlockCoordinates at) {
    const int32_t row = table_.find(at);
    if (row >= 0 && !listed[row]) listed[row] = 1, rows.push_back(row);
  };
  for (const BlockCoordinates& at : touched) {
    list(at);
    for (const BlockCoordinates& face : kFaces) list(at + face);
  }
  // What is thin in a block depends on the crossings in the blocks at its faces.
  std::vector<BlockSites> found;
  const std::size_t own = rows.size();
  for (const int32_t row : find_crossings(context, rows, found))
    for (const BlockCoordinates& face : kFaces) list(table_.at(row) + face);
  for (std::size_t i = own; i < rows.size(); ++i) found.push_back(crossings_of(*blocks_[rows[i]]));
  std::vector<int64_t> changes(rows.size());
  context.pool.parallel_for(rows.size(), 16, [&](std::size_t begin, std::size_t end, int) {
    std::vector<Site> came;
    for (std::size_t i = begin; i < end; ++i) {
      FieldBlock& block = *blocks_[rows[i]];
      BlockSites& now = found[i];
      add_thin(rows[i], now);
      std::memcpy(block.known, now.known, sizeof now.known);
      std::memcpy(block.negative, now.negative, sizeof now.negative);
      came.clear();
      changes[i] = take_sites(block, now.sites, came);
      if (changes[i] == 0) continue;
      block.touched = true;
      make_leaves(block.sites, kMostInLeaf, slack_, block.tree);
      make_leaves(came, kMostThatCame, slack_, block.arrived);
    }
  });
  for (const int64_t n : changes) stats.changed_sites += n;
}

}  // namespace ggslam::volumes
