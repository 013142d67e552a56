// SPDX-License-Identifier: Apache-2.0
// A target as the union of parts. Blocks that have the same parts as before are copied; only the others are put together
// and finished again (and those beside them, where a voxel's shape depends on its neighbours).
#include <algorithm>

#include "common/guard.hpp"
#include "tracking/gicp_target.hpp"

GGSLAM_DECLARE_KERNEL(void merge_moments(const VoxelMoments* parts, std::size_t count, VoxelMoments* sum))
GGSLAM_DECLARE_KERNEL(void finish_voxels(const TargetSettings& settings, const VoxelLevelView& level,
                                         const VoxelMoments* moments, std::size_t begin, std::size_t end, Voxel* out))

namespace ggslam {
namespace {

using Parts = std::vector<std::shared_ptr<const TargetPart>>;

struct Change {
  uint64_t order, key;
  BlockSource source;
  bool added;
};

// Blocks of the parts that only one of the two lists has, in order.
std::vector<Change> changes_between(const Parts& before, const Parts& after) {
  const auto pointers = [](const Parts& parts) {
    std::vector<const TargetPart*> found;
    for (const auto& part : parts) found.push_back(part.get());
    std::sort(found.begin(), found.end());
    return found;
  };
  const std::vector<const TargetPart*> old = pointers(before), now = pointers(after);
  std::vector<Change> changes;
  const auto note = [&](const Parts& parts, const std::vector<const TargetPart*>& others, bool added) {
    for (const auto& part : parts)
      if (!std::binary_search(others.begin(), others.end(), part.get()))
        for (uint32_t b = 0; b < part->blocks.size(); ++b)
          changes.push_back({part->orders[b], part->keys[b], {part.get(), b}, added});
  };
  note(before, now, false);
  note(after, old, true);
  std::sort(changes.begin(), changes.end(), [](const Change& x, const Change& y) {
    if (x.order != y.order) return x.order < y.order;
    return x.added != y.added ? x.added < y.added : x.source.part->rank < y.source.part->rank;
  });
  return changes;
}

template <typename T>
void append(const std::vector<T>& from, std::size_t begin, std::size_t end, std::vector<T>& to) {
  to.insert(to.end(), from.begin() + static_cast<std::ptrdiff_t>(begin), from.begin() + static_cast<std::ptrdiff_t>(end));
}

// Voxels that are still to be finished, and their moments where the level keeps none.
struct Unfinished {
  std::vector<int32_t> voxels;
  std::vector<VoxelMoments> moments;
};

class Composer {
 public:
  Composer(Context& context, const GicpTarget& before, const TargetSettings& settings, GicpTarget& out)
      : context_(context), before_(before), settings_(settings), out_(out), neighbours_(settings.neighbour_weight > 0) {}

  void run(Parts parts) {
    const std::vector<Change> changes = changes_between(before_.composition.parts, parts);
    out_.composition.parts = std::move(parts);
    out_.fine.size = settings_.voxel;
    out_.coarse.size = 4 * settings_.voxel;
    reserve(changes.size());
    const std::vector<uint64_t>& orders = before_.composition.orders;
    std::size_t done = 0;
    for (std::size_t c = 0; c < changes.size();) {
      std::size_t end = c;
      while (end < changes.size() && changes[end].order == changes[c].order) ++end;
      const auto found = std::lower_bound(orders.begin() + static_cast<std::ptrdiff_t>(done), orders.end(), changes[c].order);
      const std::size_t at = static_cast<std::size_t>(found - orders.begin());
      copy_blocks(done, at);
      const bool there = at < orders.size() && orders[at] == changes[c].order;
      put_together(there ? static_cast<std::ptrdiff_t>(at) : -1, &changes[c], &changes[end]);
      done = at + there;
      c = end;
    }
    copy_blocks(done, orders.size());
    group_coarse();
    out_.fine.index_blocks();
    out_.coarse.index_blocks();
    if (neighbours_) choose_neighbourhoods(changes);
    finish(out_.fine, fine_);
    finish(out_.coarse, coarse_);
  }

 private:
  void reserve(std::size_t changes) {
    const std::size_t blocks = before_.composition.orders.size() + changes;
    const std::size_t voxels = before_.fine.voxels.size() + 16 * changes;
    out_.composition.orders.reserve(blocks), out_.composition.source_end.reserve(blocks);
    out_.fine.blocks.reserve(blocks), out_.fine.block_keys.reserve(blocks), out_.coarse.voxels.reserve(blocks);
    out_.fine.voxels.reserve(voxels);
    if (neighbours_) out_.fine.moments.reserve(voxels), out_.coarse.moments.reserve(blocks);
  }

  // Blocks [begin, end) of `before` as they are.
  void copy_blocks(std::size_t begin, std::size_t end) {
    if (begin == end) return;
    const Composition& from = before_.composition;
    Composition& to = out_.composition;
    const auto first_voxel = [&](std::size_t b) {
      return b < before_.fine.blocks.size() ? before_.fine.blocks[b].first : before_.fine.voxels.size();
    };
    const std::size_t voxel = first_voxel(begin), voxel_end = first_voxel(end);
    const uint32_t shift = static_cast<uint32_t>(out_.fine.voxels.size() - voxel);
    for (std::size_t b = begin; b < end; ++b) {
      VoxelBlock block = before_.fine.blocks[b];
      block.first += shift;
      out_.fine.blocks.push_back(block);
    }
    append(before_.fine.voxels, voxel, voxel_end, out_.fine.voxels);
    append(before_.fine.block_keys, begin, end, out_.fine.block_keys);
    append(before_.coarse.voxels, begin, end, out_.coarse.voxels);
    if (neighbours_) {
      append(before_.fine.moments, voxel, voxel_end, out_.fine.moments);
      append(before_.coarse.moments, begin, end, out_.coarse.moments);
    }
    append(from.orders, begin, end, to.orders);
    const uint32_t source = begin ? from.source_end[begin - 1] : 0;
    const uint32_t source_shift = static_cast<uint32_t>(to.sources.size()) - source;
    for (std::size_t b = begin; b < end; ++b) to.source_end.push_back(from.source_end[b] + source_shift);
    append(from.sources, source, from.source_end[end - 1], to.sources);
  }

  // One block from its parts: those it had (block `old` of `before`, or -1) with the changes.
  void put_together(std::ptrdiff_t old, const Change* begin, const Change* end) {
    sources_.clear();
    if (old >= 0) {
      const Composition& from = before_.composition;
      append(from.sources, old ? from.source_end[static_cast<std::size_t>(old) - 1] : 0,
             from.source_end[static_cast<std::size_t>(old)], sources_);
    }
    for (const Change* c = begin; c < end; ++c) {
      if (c->added) {
        sources_.push_back(c->source);
      } else {
        const auto same = [&](const BlockSource& s) { return s.part == c->source.part; };
        sources_.erase(std::remove_if(sources_.begin(), sources_.end(), same), sources_.end());
      }
    }
    if (sources_.empty()) return;
    std::sort(sources_.begin(), sources_.end(),
              [](const BlockSource& x, const BlockSource& y) { return x.part->rank < y.part->rank; });
    Composition& to = out_.composition;
    to.orders.push_back(begin->order);
    append(sources_, 0, sources_.size(), to.sources);
    to.source_end.push_back(static_cast<uint32_t>(to.sources.size()));
    out_.fine.block_keys.push_back(begin->key);
    uint64_t occupied = 0;
    for (const BlockSource& s : sources_) occupied |= s.part->blocks[s.block].occupied;
    out_.fine.blocks.push_back({occupied, static_cast<uint32_t>(out_.fine.voxels.size()), 0});
    sources_.size() == 1 ? take_over(sources_[0]) : merge(begin->key, occupied);
  }

  // A block of one part alone.
  void take_over(const BlockSource& source) {
    const TargetPart& part = *source.part;
    const std::size_t first = part.blocks[source.block].first;
    const std::size_t end = first + static_cast<std::size_t>(__builtin_popcountll(part.blocks[source.block].occupied));
    if (!neighbours_) {
      append(part.voxels, first, end, out_.fine.voxels);
      out_.coarse.voxels.push_back(part.coarse_voxels[source.block]);
      return;
    }
    append(part.moments, first, end, out_.fine.moments);
    out_.fine.voxels.resize(out_.fine.moments.size());
    out_.coarse.moments.push_back(part.coarse_moments[source.block]);
    out_.coarse.voxels.emplace_back();
  }

  // A block of several parts: their moments are added up in the order of their ranks.
  void merge(uint64_t key, uint64_t occupied) {
    const auto add = GGSLAM_DISPATCH(context_.isa, merge_moments);
    VoxelMoments merged[64];
    int count = 0;
    for (uint64_t rest = occupied; rest; rest &= rest - 1, ++count) {
      const uint64_t bit = rest & (~rest + 1);
      const Voxel* alone = nullptr;
      int members = 0;
      for (const BlockSource& s : sources_) {
        const VoxelBlock& block = s.part->blocks[s.block];
        if (!(block.occupied & bit)) continue;
        const std::size_t index = block.first + static_cast<std::size_t>(__builtin_popcountll(block.occupied & (bit - 1)));
        if (members++) {
          add(&s.part->moments[index], 1, &merged[count]);
        } else {
          merged[count] = s.part->moments[index];
          if (!neighbours_) alone = &s.part->voxels[index];
        }
      }
      const bool finished = alone && members == 1;
      if (!finished) note(fine_, out_.fine.voxels.size(), merged[count]);
      out_.fine.voxels.push_back(finished ? *alone : Voxel{});
    }
    const VoxelMoments sum = coarse_moments(context_.isa, key, merged, static_cast<std::size_t>(count), out_.coarse.size);
    note(coarse_, out_.coarse.voxels.size(), sum);
    out_.coarse.voxels.emplace_back();
    if (!neighbours_) return;
    out_.fine.moments.insert(out_.fine.moments.end(), merged, merged + count);
    out_.coarse.moments.push_back(sum);
  }

  // With neighbours, whole blocks are chosen later.
  void note(Unfinished& list, std::size_t voxel, const VoxelMoments& moments) const {
    if (neighbours_) return;
    list.voxels.push_back(static_cast<int32_t>(voxel));
    list.moments.push_back(moments);
  }

  // Fine block i is coarse voxel i.
  void group_coarse() {
    const std::vector<uint64_t>& orders = out_.composition.orders;
    for (std::size_t b = 0; b < orders.size(); ++b) {
      if (!b || orders[b] >> 6 != orders[b - 1] >> 6) {
        out_.coarse.block_keys.push_back(coarse_key_of(orders[b]));
        out_.coarse.blocks.push_back({0, static_cast<uint32_t>(b), 0});
      }
      out_.coarse.blocks.back().occupied |= uint64_t{1} << (orders[b] & 63);
    }
  }

  // Blocks that changed or went, and the 26 around each: as coarse voxels, and all voxels in them.
  void choose_neighbourhoods(const std::vector<Change>& changes) {
    std::vector<char> chosen(out_.fine.blocks.size(), 0);
    for (std::size_t i = 0; i < changes.size(); ++i) {
      if (i && changes[i].order == changes[i - 1].order) continue;
      const Vec3i c = block_coordinates(changes[i].key);
      for (int n = 0; n < 27; ++n) {
        const int b = out_.fine.block_of(block_key(c[0] + n % 3 - 1, c[1] + n / 3 % 3 - 1, c[2] + n / 9 - 1));
        if (b >= 0) chosen[static_cast<std::size_t>(b)] = 1;
      }
    }
    for (std::size_t b = 0; b < chosen.size(); ++b) {
      if (!chosen[b]) continue;
      coarse_.voxels.push_back(static_cast<int32_t>(b));
      const VoxelBlock& block = out_.fine.blocks[b];
      for (int v = 0; v < __builtin_popcountll(block.occupied); ++v)
        fine_.voxels.push_back(static_cast<int32_t>(block.first) + v);
    }
  }

  void finish(VoxelLevel& level, const Unfinished& list) {
    const auto kernel = GGSLAM_DISPATCH(context_.isa, finish_voxels);
    const VoxelLevelView view = level.view();
    context_.pool.parallel_for(list.voxels.size(), 256, [&](std::size_t begin, std::size_t end, int) {
      for (std::size_t i = begin; i < end; ++i) {
        const std::size_t voxel = static_cast<std::size_t>(list.voxels[i]);
        if (neighbours_)
          kernel(settings_, view, level.moments.data(), voxel, voxel + 1, level.voxels.data());
        else
          kernel(settings_, view, &list.moments[i], 0, 1, &level.voxels[voxel]);
      }
    });
  }

  Context& context_;
  const GicpTarget& before_;
  const TargetSettings& settings_;
  GicpTarget& out_;
  const bool neighbours_;  // whether a voxel's shape depends on its neighbours
  std::vector<BlockSource> sources_;
  Unfinished fine_, coarse_;
};

}  // namespace

void GicpTarget::compose(Context& context, const GicpTarget* before, Parts parts, const TargetSettings& settings) {
  const GicpTarget nothing;
  *this = GicpTarget{};
  Composer(context, before ? *before : nothing, settings, *this).run(std::move(parts));
}

}  // namespace ggslam

// --- C interface ------------------------------------------------------------------------------------------------------

using PartHandle = std::shared_ptr<const ggslam::TargetPart>;

GGSLAM_EXPORT void* ggslam_target_part_create(const void* context, const ggslam::TargetInput* input,
                                              const ggslam::TargetSettings* settings, uint64_t rank) try {
  ggslam::check_target(input, settings);
  auto part = std::make_shared<ggslam::TargetPart>();
  part->rank = rank;
  part->build(ggslam::object_of<ggslam::Context>(context).isa, *input, *settings);
  return new PartHandle(std::move(part));
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_target_part_destroy(void* part) try {
  delete static_cast<PartHandle*>(part);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int64_t ggslam_target_part_bytes(const void* part) try {
  return static_cast<int64_t>((ggslam::object_of<PartHandle>(part))->bytes());
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_gicp_target_compose(void* context, void* target, const void* before, const void* const* parts,
                                             int count, const ggslam::TargetSettings* settings) try {
  ggslam::check_array("parts", parts, count);
  ggslam::check_range("voxel", ggslam::object_of<ggslam::TargetSettings>(settings).voxel, 1e-6f, 1e6f);
  std::vector<PartHandle> own;
  for (int i = 0; i < count; ++i) own.push_back(ggslam::object_of<PartHandle>(parts[i]));
  ggslam::object_of<ggslam::GicpTarget>(target).compose(ggslam::object_of<ggslam::Context>(context),
                                                    static_cast<const ggslam::GicpTarget*>(before), std::move(own),
                                                    *settings);
  return 0;
} GGSLAM_CATCH_ALL
