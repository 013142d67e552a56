// SPDX-License-Identifier: Apache-2.0
#include "tracking/growing_target.hpp"

#include <atomic>
#include <unordered_map>

#include "common/guard.hpp"
#include "tracking/gicp_target.hpp"
#include "tracking/target_kernels.hpp"

namespace ggslam {
namespace {

constexpr std::size_t kBlocksAtATime = 8;

// Gaussians by the block they lie in, blocks in the order of their first one, Gaussians in theirs.
struct Members {
  std::vector<ChangedBlock> blocks;
  std::vector<std::size_t> begin;  // of each block's members, and all
  std::vector<int32_t> gaussians;
  std::vector<uint8_t> bits;
};

Members sort_members(Context& context, const TargetInput& input, const TargetSettings& settings) {
  const std::size_t n = static_cast<std::size_t>(input.count);
  std::vector<uint64_t> keys(n);
  std::vector<uint8_t> bits(n);
  const auto bin = GGSLAM_DISPATCH(context.isa, bin_gaussians);
  context.pool.parallel_for(n, 1024, [&](std::size_t begin, std::size_t end, int) {
    bin(input, settings, begin, end, keys.data(), bits.data());
  });
  Members found;
  std::unordered_map<uint64_t, std::size_t> known;
  std::vector<std::size_t> block_of(n), counts;
  uint64_t last = kEmptyKey;
  std::size_t block = 0;
  for (std::size_t g = 0; g < n; ++g) {
    if (keys[g] == kEmptyKey) continue;
    if (keys[g] != last) {  // mostly the block of the Gaussian before
      block = known.emplace(keys[g], found.blocks.size()).first->second;
      if (block == found.blocks.size()) found.blocks.push_back({keys[g], 0}), counts.push_back(0);
      last = keys[g];
    }
    found.blocks[block].added |= uint64_t{1} << bits[g];
    block_of[g] = block;
    ++counts[block];
  }
  found.begin.assign(1, 0);
  for (const std::size_t count : counts) found.begin.push_back(found.begin.back() + count);
  std::vector<std::size_t> next(found.begin.begin(), found.begin.end() - 1);
  found.gaussians.resize(found.begin.back()), found.bits.resize(found.begin.back());
  for (std::size_t g = 0; g < n; ++g) {
    if (keys[g] == kEmptyKey) continue;
    const std::size_t at = next[block_of[g]]++;
    found.gaussians[at] = static_cast<int32_t>(g), found.bits[at] = bits[g];
  }
  return found;
}

uint32_t voxel_of(const VoxelBlock& block, int bit) {
  return block.first + static_cast<uint32_t>(__builtin_popcountll(block.occupied & ((uint64_t{1} << bit) - 1)));
}

// Moments of a block at its new place: as they were, or without members. Those for which `renew` are left alone.
void take_over(const PlacedBlock& p, float size, uint64_t renew, VoxelMoments* moments) {
  VoxelMoments* out = moments + p.now.first;
  const VoxelMoments* old = moments + p.before.first;
  for (uint64_t rest = p.now.occupied; rest; rest &= rest - 1, ++out) {
    const int bit = __builtin_ctzll(rest);
    const bool was = p.before.occupied >> bit & 1;
    if (!(renew >> bit & 1)) *out = was ? *old : empty_moments(p.key, bit, size);
    old += was;
  }
}

// Fine blocks as voxels of the coarse level: the coarse blocks they lie in, and where each of them is.
struct CoarseVoxels {
  std::vector<ChangedBlock> blocks;
  std::vector<std::vector<std::pair<int, std::size_t>>> members;  // bit, and which fine block
};

CoarseVoxels coarsen(const std::vector<ChangedBlock>& fine) {
  CoarseVoxels found;
  std::unordered_map<uint64_t, std::size_t> known;
  for (std::size_t b = 0; b < fine.size(); ++b) {
    const Vec3i c = block_coordinates(fine[b].key);
    const uint64_t key = block_key(c[0] >> 2, c[1] >> 2, c[2] >> 2);
    const int bit = (c[0] & 3) + 4 * (c[1] & 3) + 16 * (c[2] & 3);
    const auto [at, is_new] = known.emplace(key, found.blocks.size());
    if (is_new) found.blocks.push_back({key, 0}), found.members.emplace_back();
    found.blocks[at->second].added |= uint64_t{1} << bit;
    found.members[at->second].emplace_back(bit, b);
  }
  return found;
}

}  // namespace

uint64_t new_target_number() {
  static std::atomic<uint64_t> last{0};
  return ++last;
}

GrowingTarget::GrowingTarget(const GicpTarget& base, const TargetSettings& settings)
    : number(new_target_number()),
      origin(base.grown ? 0 : base.number),
      fine(settings.voxel),
      coarse(4 * settings.voxel) {
  const bool shaped = base.is_finished();
  for (const int level : {0, 1}) {
    GrowingLevel& to = level ? coarse : fine;
    const LevelContents from = base.contents(level);
    from.for_each_block([&](uint64_t key, const VoxelBlock& block) {
      to.append(key, block.occupied, from.moments + block.first, shaped ? from.view.voxels + block.first : nullptr);
    });
  }
}

void GrowingTarget::add(Context& context, const TargetInput& input, const TargetSettings& settings) {
  const uint32_t oldest = held_.empty() ? newest : *held_.begin(), version = ++newest;
  fine.collect(oldest), coarse.collect(oldest);
  const bool spread = settings.scatter_weight > 0 && settings.neighbour_weight > 0;
  const Members members = sort_members(context, input, settings);
  const std::vector<PlacedBlock> blocks = fine.place(members.blocks, spread, version);
  const auto accumulate = GGSLAM_DISPATCH(context.isa, accumulate_members);
  context.pool.parallel_for(blocks.size(), kBlocksAtATime, [&](std::size_t begin, std::size_t end, int) {
    std::vector<int32_t> voxels;
    for (std::size_t b = begin; b < end; ++b) {
      take_over(blocks[b], settings.voxel, 0, fine.moments());
      if (b >= members.blocks.size()) continue;  // beside a block that changes
      const std::size_t first = members.begin[b], last = members.begin[b + 1];
      voxels.clear();
      for (std::size_t i = first; i < last; ++i)
        voxels.push_back(static_cast<int32_t>(voxel_of(blocks[b].now, members.bits[i])));
      accumulate(input, settings, members.gaussians.data() + first, voxels.data(), last - first, fine.moments());
    }
  });
  const CoarseVoxels wide = coarsen(members.blocks);
  const std::vector<PlacedBlock> coarse_blocks = coarse.place(wide.blocks, spread, version);
  const float size = 4 * settings.voxel;
  context.pool.parallel_for(coarse_blocks.size(), kBlocksAtATime, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t c = begin; c < end; ++c) {
      take_over(coarse_blocks[c], size, coarse_blocks[c].added, coarse.moments());
      if (c >= wide.blocks.size()) continue;
      for (const auto& [bit, b] : wide.members[c]) {
        const VoxelBlock& block = blocks[b].now;
        coarse.moments()[voxel_of(coarse_blocks[c].now, bit)] =
            coarse_moments(context.isa, blocks[b].key, fine.moments() + block.first,
                           static_cast<std::size_t>(__builtin_popcountll(block.occupied)), size);
      }
    }
  });
}

TargetVersion::TargetVersion(std::shared_ptr<GrowingTarget> target)
    : of(std::move(target)), fine(of->fine.hold(of->newest)), coarse(of->coarse.hold(of->newest)) {
  of->hold(fine.version);
}

TargetVersion::~TargetVersion() {
  const std::lock_guard<std::mutex> lock(of->mutex);
  of->release(fine.version);
}

void TargetVersion::finish(Context& context, const TargetSettings& settings) {
  const std::lock_guard<std::mutex> lock(of->mutex);
  if (finished) return;
  const auto shape = GGSLAM_DISPATCH(context.isa, finish_voxels);
  for (const bool is_coarse : {false, true}) {
    GrowingLevel& level = is_coarse ? of->coarse : of->fine;
    HeldLevel& held = is_coarse ? coarse : fine;
    level.move(held);  // later versions see the shapes
    const std::vector<VoxelBlock> blocks = level.take_unshaped(held.version);
    const VoxelLevelView view = held.view();
    context.pool.parallel_for(blocks.size(), kBlocksAtATime, [&](std::size_t begin, std::size_t end, int) {
      for (std::size_t b = begin; b < end; ++b) {
        const std::size_t first = blocks[b].first;
        shape(settings, view, held.moments.get(), first,
              first + static_cast<std::size_t>(__builtin_popcountll(blocks[b].occupied)), held.voxels.get());
      }
    });
  }
  finished = true;
}

std::unique_ptr<TargetVersion> grow(Context& context, const GicpTarget& base, const TargetInput& input,
                                    const TargetSettings& settings) {
  std::shared_ptr<GrowingTarget> target;
  std::unique_lock<std::mutex> lock;
  if (!base.composition.parts.empty()) refuse("target: one that is composed of parts can only grow by parts");
  if (base.grown) {
    lock = std::unique_lock<std::mutex>(base.grown->of->mutex);
    if (base.grown->of->newest == base.grown->fine.version) target = base.grown->of;
  }
  if (!target) {  // others have grown from it: it is copied
    lock = {};
    target = std::make_shared<GrowingTarget>(base, settings);
    lock = std::unique_lock<std::mutex>(target->mutex);
  }
  target->add(context, input, settings);
  return std::make_unique<TargetVersion>(target);
}

}  // namespace ggslam
