// SPDX-License-Identifier: Apache-2.0
#include "tracking/gicp_target.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <memory>
#include <numeric>

#include "common/guard.hpp"
#include "tracking/target_kernels.hpp"

namespace ggslam {
namespace {

constexpr int kPartitions = 64;      // by hash of the block, so that threads fill separate tables
constexpr std::size_t kChunk = 4096;  // Gaussians that one thread sorts at a time

int partition_of(uint64_t key) { return static_cast<int>(hash_key(key) >> 58); }

// The members of one partition, its blocks in the order of their first member, and its voxels' moments.
struct Partition {
  std::vector<int32_t> members, voxels;  // Gaussian, and its voxel in `moments`
  std::vector<uint64_t> keys;
  std::vector<VoxelBlock> blocks;
  std::vector<VoxelMoments> moments;
};

// Puts the Gaussians of each partition in one run, in the order of the map.
struct Sorted {
  std::unique_ptr<uint64_t[]> keys;
  std::unique_ptr<uint8_t[]> bits;
  std::vector<int32_t> order;
  std::array<std::size_t, kPartitions + 1> begin{};
};

Sorted sort_by_partition(Context& context, const TargetInput& input, const TargetSettings& settings) {
  const std::size_t n = input.count, chunks = (n + kChunk - 1) / kChunk;
  Sorted s;
  s.keys.reset(new uint64_t[n]);
  s.bits.reset(new uint8_t[n]);
  std::vector<std::array<std::size_t, kPartitions>> counts(chunks);
  const auto bin = GGSLAM_DISPATCH(context.isa, bin_gaussians);
  context.pool.parallel_for(chunks, 1, [&](std::size_t first, std::size_t last, int) {
    for (std::size_t c = first; c < last; ++c) {
      const std::size_t begin = c * kChunk, end = std::min(n, begin + kChunk);
      bin(input, settings, begin, end, s.keys.get(), s.bits.get());
      counts[c].fill(0);
      for (std::size_t g = begin; g < end; ++g)
        if (s.keys[g] != kEmptyKey) ++counts[c][partition_of(s.keys[g])];
    }
  });
  std::size_t total = 0;
  for (int p = 0; p < kPartitions; ++p) {
    s.begin[p] = total;
    for (auto& chunk : counts) {
      const std::size_t here = chunk[p];
      chunk[p] = total;
      total += here;
    }
  }
  s.begin[kPartitions] = total;
  s.order.resize(total);
  context.pool.parallel_for(chunks, 1, [&](std::size_t first, std::size_t last, int) {
    for (std::size_t c = first; c < last; ++c)
      for (std::size_t g = c * kChunk; g < std::min(n, (c + 1) * kChunk); ++g)
        if (s.keys[g] != kEmptyKey) s.order[counts[c][partition_of(s.keys[g])]++] = static_cast<int32_t>(g);
  });
  return s;
}

// The voxels of the blocks, empty.
void make_moments(float size, Partition& out) {
  std::size_t voxels = 0;
  for (const VoxelBlock& b : out.blocks) voxels += __builtin_popcountll(b.occupied);
  out.moments.reserve(voxels);
  for (std::size_t b = 0; b < out.blocks.size(); ++b) {
    out.blocks[b].first = static_cast<uint32_t>(out.moments.size());
    for (uint64_t rest = out.blocks[b].occupied; rest; rest &= rest - 1)
      out.moments.push_back(empty_moments(out.keys[b], __builtin_ctzll(rest), size));
  }
}

// Finds the blocks and voxels of one partition and adds up its members.
template <typename Accumulate>
void fill_partition(const Sorted& s, int p, const TargetInput& input, const TargetSettings& settings,
                    Accumulate accumulate, Partition& out) {
  const std::size_t begin = s.begin[p], n = s.begin[p + 1] - begin;
  std::size_t capacity = 16;
  while (capacity < 2 * n) capacity *= 2;
  std::vector<int32_t> slots(capacity, -1);
  const auto block_of = [&](uint64_t key) {
    std::size_t slot = hash_key(key) & (capacity - 1);
    while (slots[slot] >= 0 && out.keys[slots[slot]] != key) slot = (slot + 1) & (capacity - 1);
    if (slots[slot] < 0) {
      slots[slot] = static_cast<int32_t>(out.blocks.size());
      out.keys.push_back(key);
      out.blocks.push_back({0, 0, 0});
    }
    return slots[slot];
  };
  out.voxels.resize(n);
  for (std::size_t i = 0; i < n; ++i) {
    const int32_t g = s.order[begin + i];
    out.voxels[i] = block_of(s.keys[g]);
    out.blocks[out.voxels[i]].occupied |= uint64_t{1} << s.bits[g];
  }
  make_moments(settings.voxel, out);
  for (std::size_t i = 0; i < n; ++i) {
    const VoxelBlock& b = out.blocks[out.voxels[i]];
    const uint64_t below = (uint64_t{1} << s.bits[s.order[begin + i]]) - 1;
    out.voxels[i] = static_cast<int32_t>(b.first) + __builtin_popcountll(b.occupied & below);
  }
  accumulate(input, settings, s.order.data() + begin, out.voxels.data(), n, out.moments.data());
}

// Partitions are freed as they are taken over: a map's moments are not there twice.
void concatenate(std::vector<Partition>& partitions, VoxelLevel& level) {
  level.blocks.clear(), level.block_keys.clear(), level.moments.clear();
  std::size_t blocks = 0, moments = 0;
  for (const Partition& p : partitions) blocks += p.blocks.size(), moments += p.moments.size();
  level.blocks.reserve(blocks), level.block_keys.reserve(blocks), level.moments.reserve(moments);
  for (Partition& p : partitions) {
    const uint32_t base = static_cast<uint32_t>(level.moments.size());
    for (VoxelBlock b : p.blocks) {
      b.first += base;
      level.blocks.push_back(b);
    }
    level.block_keys.insert(level.block_keys.end(), p.keys.begin(), p.keys.end());
    level.moments.insert(level.moments.end(), p.moments.begin(), p.moments.end());
    p = Partition{};
  }
}

// For each block of a level the one of another level that holds the same voxels with the same moments, or -1.
std::vector<int32_t> equal_blocks(Context& context, const VoxelLevel& level, const LevelContents& before) {
  std::vector<int32_t> equal(level.blocks.size(), -1);
  context.pool.parallel_for(equal.size(), 256, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t b = begin; b < end; ++b) {
      const int other = find_block(before.view, level.block_keys[b]);
      if (other < 0 || before.view.blocks[other].occupied != level.blocks[b].occupied) continue;
      const std::size_t bytes = sizeof(VoxelMoments) * __builtin_popcountll(level.blocks[b].occupied);
      if (!std::memcmp(level.moments.data() + level.blocks[b].first, before.moments + before.view.blocks[other].first,
                       bytes))
        equal[b] = other;
    }
  });
  return equal;
}

// Whether the blocks around one are as before, too: then its voxels have the shapes that they had.
bool has_equal_neighbours(const VoxelLevel& level, const LevelContents& before, const std::vector<int32_t>& equal,
                          std::size_t block) {
  const Vec3i c = block_coordinates(level.block_keys[block]);
  for (int z = -1; z <= 1; ++z)
    for (int y = -1; y <= 1; ++y)
      for (int x = -1; x <= 1; ++x) {
        const uint64_t key = block_key(c[0] + x, c[1] + y, c[2] + z);
        const int near = level.block_of(key);
        if (near >= 0 ? equal[near] < 0 : find_block(before.view, key) >= 0) return false;
      }
  return true;
}

// A coarse voxel is a block of the fine level.
template <typename Merge>
void coarsen(const VoxelLevel& fine, Merge merge, VoxelLevel& coarse) {
  coarse.size = 4 * fine.size;
  struct Entry {
    uint64_t key;
    int bit, block;
  };
  std::vector<Entry> entries;
  for (std::size_t b = 0; b < fine.blocks.size(); ++b) {
    const Vec3i c = block_coordinates(fine.block_keys[b]);
    entries.push_back({block_key(c[0] >> 2, c[1] >> 2, c[2] >> 2), (c[0] & 3) + 4 * (c[1] & 3) + 16 * (c[2] & 3),
                       static_cast<int>(b)});
  }
  std::sort(entries.begin(), entries.end(),
            [](const Entry& x, const Entry& y) { return x.key != y.key ? x.key < y.key : x.bit < y.bit; });
  coarse.blocks.clear(), coarse.block_keys.clear(), coarse.moments.clear();
  for (const Entry& e : entries) {
    if (coarse.block_keys.empty() || coarse.block_keys.back() != e.key) {
      coarse.block_keys.push_back(e.key);
      coarse.blocks.push_back({0, static_cast<uint32_t>(coarse.moments.size()), 0});
    }
    coarse.blocks.back().occupied |= uint64_t{1} << e.bit;
    coarse.moments.push_back(empty_moments(e.key, e.bit, coarse.size));
    const VoxelBlock& block = fine.blocks[e.block];
    merge(fine.moments.data() + block.first, __builtin_popcountll(block.occupied), &coarse.moments.back());
  }
}

}  // namespace

void VoxelLevel::index_blocks() {
  std::size_t capacity = 64;
  while (capacity < 4 * blocks.size()) capacity *= 2;
  slot_key.assign(capacity, kEmptyKey);
  slot_block.assign(capacity, -1);
  for (std::size_t b = 0; b < blocks.size(); ++b) {
    std::size_t slot = hash_key(block_keys[b]) & (capacity - 1);
    while (slot_key[slot] != kEmptyKey) slot = (slot + 1) & (capacity - 1);
    slot_key[slot] = block_keys[b];
    slot_block[slot] = static_cast<int32_t>(b);
  }
}

VoxelLevelView VoxelLevel::view() const {
  return {voxels.data(),     blocks.data(), nullptr,  slot_key.data(), slot_block.data(),
          slot_key.size() - 1, size,        1 / size, 0};
}

LevelContents GicpTarget::contents(int level) const {
  if (grown) {
    const HeldLevel& held = level ? grown->coarse : grown->fine;
    return {held.view(),      held.moments.get(), held.keys.get(), held.block_count,
            held.voxel_count, held.places,        false};
  }
  const VoxelLevel& flat = level ? coarse : fine;
  const std::size_t count = std::max(flat.voxels.size(), flat.moments.size());
  return {flat.view(), flat.moments.data(), flat.block_keys.data(), flat.blocks.size(), count, count, true};
}

bool GicpTarget::is_finished() const {
  if (grown) return grown->finished;
  for (const VoxelLevel* level : {&fine, &coarse})
    if (level->slot_key.empty() || level->voxels.size() < level->moments.size()) return false;
  return true;
}

void GicpTarget::build(Context& context, const GicpTarget* base, const TargetInput& input,
                       const TargetSettings& settings, const GicpTarget* like) {
  gather(context, base, input, settings);
  finish(context, settings, like ? like : base);
}

void GicpTarget::gather(Context& context, const GicpTarget* base, const TargetInput& input,
                        const TargetSettings& settings) {
  if (base) {
    std::unique_ptr<TargetVersion> version = grow(context, *base, input, settings);
    *this = GicpTarget{};
    grown = std::move(version);
    return;
  }
  const Sorted sorted = sort_by_partition(context, input, settings);
  std::vector<Partition> partitions(kPartitions);
  const auto accumulate = GGSLAM_DISPATCH(context.isa, accumulate_members);
  context.pool.parallel_for(kPartitions, 1, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t p = begin; p < end; ++p)
      fill_partition(sorted, static_cast<int>(p), input, settings, accumulate, partitions[p]);
  });
  *this = GicpTarget{};
  fine.size = settings.voxel;
  concatenate(partitions, fine);
  coarsen(fine, GGSLAM_DISPATCH(context.isa, merge_moments), coarse);
}

void GicpTarget::finish(Context& context, const TargetSettings& settings, const GicpTarget* like) {
  const auto shape = GGSLAM_DISPATCH(context.isa, finish_voxels);
  const bool usable = like && like->shaped && !std::memcmp(&like->shaped_with, &settings, sizeof settings);
  for (int which = 0; which < 2 && !grown; ++which) {
    VoxelLevel& level = which ? coarse : fine;
    level.index_blocks();
    level.voxels.resize(level.moments.size());
    const VoxelLevelView view = level.view();
    const LevelContents before = usable ? like->contents(which) : LevelContents{};
    const std::vector<int32_t> equal = usable ? equal_blocks(context, level, before) : std::vector<int32_t>();
    context.pool.parallel_for(level.blocks.size(), 16, [&](std::size_t begin, std::size_t end, int) {
      for (std::size_t b = begin; b < end; ++b) {
        const std::size_t first = level.blocks[b].first, count = __builtin_popcountll(level.blocks[b].occupied);
        if (usable && equal[b] >= 0 && has_equal_neighbours(level, before, equal, b))
          std::copy_n(before.view.voxels + before.view.blocks[equal[b]].first, count, level.voxels.data() + first);
        else
          shape(settings, view, level.moments.data(), first, first + count, level.voxels.data());
      }
    });
  }
  if (grown) grown->finish(context, settings);
  shaped_with = settings, shaped = true;
}

}  // namespace ggslam

// --- C interface ------------------------------------------------------------------------------------------------------

namespace ggslam {

void check_target(const TargetInput* input, const TargetSettings* settings) {
  const TargetInput& in = object_of<TargetInput>(input);
  const void* const arrays[] = {in.means, in.quaternions, in.log_scales, in.opacity_logits};
  for (const void* array : arrays) check_array("gaussians", array, in.count);
  check_array("camera_positions", in.birth == nullptr ? in.means : in.camera_positions, in.cameras);
  check_range("voxel", object_of<TargetSettings>(settings).voxel, 1e-6f, 1e6f);
}

}  // namespace ggslam

GGSLAM_EXPORT void* ggslam_gicp_target_create() try {
  return new ggslam::GicpTarget;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_gicp_target_destroy(void* target) try {
  delete static_cast<ggslam::GicpTarget*>(target);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_gicp_target_build(void* context, void* target, const void* base,
                                           const ggslam::TargetInput* input,
                                           const ggslam::TargetSettings* settings) try {
  ggslam::check_target(input, settings);
  ggslam::object_of<ggslam::GicpTarget>(target).build(ggslam::object_of<ggslam::Context>(context),
      static_cast<const ggslam::GicpTarget*>(base), *input, *settings);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_gicp_target_gather(void* context, void* target, const void* base,
                                            const ggslam::TargetInput* input,
                                            const ggslam::TargetSettings* settings) try {
  ggslam::check_target(input, settings);
  ggslam::object_of<ggslam::GicpTarget>(target).gather(ggslam::object_of<ggslam::Context>(context),
      static_cast<const ggslam::GicpTarget*>(base), *input, *settings);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_gicp_target_build_like(void* context, void* target, const void* like,
                                                const ggslam::TargetInput* input,
                                                const ggslam::TargetSettings* settings) try {
  ggslam::check_target(input, settings);
  ggslam::object_of<ggslam::GicpTarget>(target).build(ggslam::object_of<ggslam::Context>(context), nullptr, *input,
                                                      *settings, static_cast<const ggslam::GicpTarget*>(like));
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_gicp_target_finish(void* context, void* target, const ggslam::TargetSettings* settings) try {
  ggslam::check_range("voxel", ggslam::object_of<ggslam::TargetSettings>(settings).voxel, 1e-6f, 1e6f);
  ggslam::object_of<ggslam::GicpTarget>(target).finish(ggslam::object_of<ggslam::Context>(context), *settings);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_gicp_target_size(const void* target, int level) try {
  return static_cast<int>(ggslam::object_of<ggslam::GicpTarget>(target).contents(level).voxel_count);
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_gicp_target_voxels(const void* target_, int level, float* out) try {
  const auto& target = ggslam::object_of<ggslam::GicpTarget>(target_);
  const ggslam::LevelContents contents = target.contents(level);
  ggslam::check_array("out", out, static_cast<std::int64_t>(contents.voxel_count));
  if (!target.is_finished()) ggslam::refuse("target: it is not finished");
  contents.for_each_block([&](uint64_t, const ggslam::VoxelBlock& block) {
    const auto count = static_cast<std::size_t>(__builtin_popcountll(block.occupied));
    out = std::copy_n(reinterpret_cast<const float*>(contents.view.voxels + block.first), 16 * count, out);
  });
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_gicp_target_normals(const void* target, const int32_t* voxels, int64_t count,
                                              float* out) try {
  const ggslam::LevelContents fine = ggslam::object_of<ggslam::GicpTarget>(target).contents(0);
  ggslam::check_array("voxels", voxels, count), ggslam::check_array("out", out, count);
  for (int64_t i = 0; i < count; ++i) {
    if (voxels[i] >= static_cast<int64_t>(fine.places)) ggslam::refuse("voxels: there is no such voxel");
    for (int a = 0; a < 3; ++a) out[3 * i + a] = voxels[i] < 0 ? 0.0f : fine.view.voxels[voxels[i]].normal[a];
  }
  return 0;
} GGSLAM_CATCH_ALL
