// SPDX-License-Identifier: Apache-2.0
// An update of the distance field: finds the sites that changed and the blocks they concern, and brings those up to date,
// the nearest first, until the time is over.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>

#include "volumes/esdf.hpp"

GGSLAM_DECLARE_KERNEL(ggslam::volumes::NearestOutput esdf_nearest(const ggslam::volumes::NearestInput& in,
                                                                  ggslam::volumes::FieldVoxels& out))

namespace ggslam::volumes {
namespace {

using Clock = std::chrono::steady_clock;

// A block that an update had no time for comes nearer by this at the next, in blocks, so that all have their turn.
constexpr double kNearerByWaiting = 4;
// A block that missed so many sites is computed anew, if half of them are different ones.
constexpr std::size_t kMostMissed = 2000;
// Blocks that a thread takes at once.
constexpr std::size_t kAtOnce = 4;

double milliseconds(Clock::time_point since) {
  return std::chrono::duration<double, std::milli>(Clock::now() - since).count();
}

void forget(FieldVoxels& voxels, int row) {
  voxels.distance[row] = std::numeric_limits<float>::quiet_NaN();
  voxels.gradient[row] = 511u | 511u << 10 | 511u << 20;
  voxels.owner[row] = kNobody;
}

template <class Do>
void each_bit(const uint64_t* words, const Do& f) {
  for (int k = 0; k < kSide; ++k)
    for (uint64_t left = words[k]; left != 0; left &= left - 1) f(kSide * kSide * k + __builtin_ctzll(left));
}

// Brings one block up to date.
class BlockUpdate {
 public:
  // `touched`: by slot, whether it is.
  BlockUpdate(const std::vector<FieldBlock*>& slots, const std::vector<uint8_t>& touched, FieldBlock& block)
      : slots_(slots), touched_(touched), block_(block) {}

  // What has to be done: voxels to search for, to measure again, and to forget.
  void plan() {
    if (block_.anew) {
      if (!block_.voxels) block_.voxels = std::make_unique<FieldVoxels>();
      for (int row = 0; row < kVoxels; ++row) forget(*block_.voxels, row);
      std::copy_n(block_.known, kSide, search_);
      return;
    }
    uint64_t gone[kSide];
    for (int k = 0; k < kSide; ++k) {
      search_[k] = block_.known[k] & ~block_.done_known[k];
      gone[k] = block_.done_known[k] & ~block_.known[k];
    }
    each_bit(gone, [&](int row) { forget(*block_.voxels, row); });
    for (int k = 0; k < kSide; ++k) {
      orphans_[k] = block_.orphans[k] & block_.known[k] & ~search_[k];
      search_[k] |= orphans_[k];
    }
    if (std::any_of(block_.owners.begin(), block_.owners.end(), [&](uint32_t slot) { return touched_[slot]; }))
      find_orphans();
    for (int k = 0; k < kSide; ++k)
      redo_[k] = block_.known[k] & ~search_[k] & (block_.negative[k] ^ block_.done_negative[k]);
  }

  NearestInput input() const {
    NearestInput in{};
    in.at = block_.at;
    in.known = block_.known, in.negative = block_.negative;
    in.search = search_, in.orphans = orphans_, in.redo = redo_;
    return in;
  }

  bool works() const {
    return searches() || std::any_of(redo_, redo_ + kSide, [](uint64_t word) { return word != 0; });
  }

  bool searches() const {
    return std::any_of(search_, search_ + kSide, [](uint64_t word) { return word != 0; });
  }

  void finish() {
    std::copy_n(block_.known, kSide, block_.done_known);
    std::copy_n(block_.negative, kSide, block_.done_negative);
    block_.anew = false, block_.waits = 0;
    std::fill_n(block_.orphans, kSide, 0);
    block_.missed.clear();
  }

  // Keeps what was planned for another time, with the groups that came.
  void put_off(const NodeTable& arrived, const std::vector<SiteGroup>& arrivals) {
    ++block_.waits;
    if (block_.anew) return;
    std::copy_n(orphans_, kSide, block_.orphans);
    for (int i = 0; i < arrived.count(); ++i) {
      const SiteGroup& group = arrivals[arrived.number(i)];
      for (int32_t s = 0; s < group.count; ++s)
        block_.missed.push_back(group.first + static_cast<uint32_t>(group.sites[s].voxel));
    }
    if (block_.missed.size() <= kMostMissed) return;
    std::sort(block_.missed.begin(), block_.missed.end());
    block_.missed.erase(std::unique(block_.missed.begin(), block_.missed.end()), block_.missed.end());
    if (block_.missed.size() > kMostMissed / 2) block_.anew = true, block_.missed.clear();
  }

  // Those of the sites that came before which are there still.
  void list_missed(const std::vector<SiteList>& lists, std::vector<MissedSite>& out) const {
    out.clear();
    for (const uint32_t owner : block_.missed) {
      const SiteList& list = lists[owner / kVoxels];
      const auto voxel = static_cast<int32_t>(owner % kVoxels);
      const Site* end = list.sites + list.count;
      const Site* site = std::lower_bound(list.sites, end, voxel, [](const Site& s, int32_t v) { return s.voxel < v; });
      if (site != end && site->voxel == voxel) out.push_back({site, list.at, owner});
    }
  }

  void finish(const NearestOutput& result) {
    finish();
    if (result.computed == 0) return;
    block_.farthest = result.farthest;
    block_.owners.clear();
    uint32_t last = kNobody;
    for (const uint32_t owner : block_.voxels->owner) {
      const uint32_t slot = owner / kVoxels;
      if (owner == kNobody || slot == last) continue;
      last = slot;
      if (std::find(block_.owners.begin(), block_.owners.end(), slot) == block_.owners.end())
        block_.owners.push_back(slot);
    }
  }

 private:
  const std::vector<FieldBlock*>& slots_;
  const std::vector<uint8_t>& touched_;
  FieldBlock& block_;
  uint64_t search_[kSide] = {}, orphans_[kSide] = {}, redo_[kSide] = {};

  // Voxels whose site went or moved.
  void find_orphans() {
    for (int k = 0; k < kSide; ++k) {
      uint64_t orphans = 0;
      const uint32_t* owners = block_.voxels->owner + kSide * kSide * k;
      uint32_t last = kNobody;  // slot; neighbours mostly have theirs in the same block
      const uint64_t* gone = nullptr;
      for (int row = 0; row < kSide * kSide; ++row) {
        const uint32_t owner = owners[row];
        if (owner == kNobody) continue;
        if (owner / kVoxels != last) {
          last = owner / kVoxels;
          gone = touched_[last] ? slots_[last]->gone : nullptr;
        }
        if (gone != nullptr) orphans |= (gone[owner % kVoxels >> 6] >> (owner & 63) & 1) << row;
      }
      orphans &= block_.known[k] & ~search_[k];
      orphans_[k] |= orphans;
      search_[k] |= orphans;
    }
  }
};

}  // namespace

Esdf::Esdf(const Tsdf& tsdf, float max_distance)
    : tsdf_(tsdf), max_distance_(max_distance / tsdf.voxel),
      slack_(0.01f + 3e-7f * (max_distance / tsdf.voxel) * (max_distance / tsdf.voxel)) {}

// Those near the place come first, and those that have waited.
void Esdf::sort(std::vector<int32_t>& rows, const Deadline& deadline) const {
  if (deadline.place == nullptr) return;
  std::vector<std::pair<double, int32_t>> order;
  order.reserve(rows.size());
  for (const int32_t row : rows) {
    double square = 0;
    for (int a = 0; a < 3; ++a) {
      const double away = vector_of(blocks_[row]->at)[a] + 0.5 - deadline.place[a] / kSide;
      square += away * away;
    }
    order.emplace_back(std::sqrt(square) - kNearerByWaiting * blocks_[row]->waits, row);
  }
  std::sort(order.begin(), order.end());
  for (std::size_t i = 0; i < rows.size(); ++i) rows[i] = order[i].second;
}

// Brings a block up to date, or puts it off.
void Esdf::bring_up(Context& context, int32_t row, bool late, FieldWorker& worker) {
  const auto begun = Clock::now();
  FieldBlock& block = *blocks_[row];
  const Region& region = regions_[region_of_[row]];
  const bool anew = block.anew = block.anew || !block.voxels;
  if (late && anew) {
    ++block.waits;
    return;
  }
  BlockUpdate update(slots_, touched_, block);
  update.plan();
  const Vec3f middle = middle_in(block, region);
  const Vec3f shift = Vec3f::all(0.5f * (kSide - 1)) - middle;
  worker.arrived.clear(0), worker.all.clear(0);
  if (!anew)
    worker.search.list(context, region.arrived, middle.v, kBlockReach, block.farthest, shift.v, worker.arrived);
  if (late) {
    update.put_off(worker.arrived, arrivals_);
    ++worker.put_off, worker.put_off_ms += milliseconds(begun);
    return;
  }
  update.list_missed(lists_, worker.missed);
  if (!anew && worker.arrived.count() == 0 && worker.missed.empty() && !update.works()) {
    update.finish();
    return;
  }
  if (update.searches())
    worker.search.list(context, region.all, middle.v, kBlockReach, max_distance_, shift.v, worker.all);
  NearestInput in = update.input();
  in.all = worker.all.columns(), in.all_numbers = worker.all.numbers();
  in.arrived = worker.arrived.columns(), in.arrived_numbers = worker.arrived.numbers();
  in.missed = worker.missed.data(), in.missed_count = static_cast<int32_t>(worker.missed.size());
  in.groups = groups_.data(), in.arrivals = arrivals_.data(), in.slots = lists_.data();
  in.voxel = tsdf_.voxel, in.max_distance = max_distance_, in.slack = slack_;
  const auto kernel = GGSLAM_DISPATCH(context.isa, esdf_nearest);
  const NearestOutput result = kernel(in, *block.voxels);
  update.finish(result);
  worker.blocks += result.computed > 0 || anew, worker.voxels += result.computed;
}

void Esdf::compute(Context& context, std::vector<int32_t>& rows, const Deadline& deadline, FieldStats& stats) {
  const auto start = Clock::now();
  const double left = deadline.milliseconds > 0 ? deadline.milliseconds - stats.sites_ms - stats.select_ms
                                                : std::numeric_limits<double>::infinity();
  sort(rows, deadline);
  std::vector<FieldWorker> workers(context.pool.size());
  std::vector<uint8_t> done(rows.size(), 0);
  context.pool.parallel_for(rows.size(), kAtOnce, [&](std::size_t begin, std::size_t end, int thread) {
    for (std::size_t i = begin; i < end; ++i) {
      const double rest = put_off_ms_ * static_cast<double>(rows.size() - i) / static_cast<double>(workers.size());
      // However late it is, something is done, or what is left over would never end.
      const bool late = i >= kAtOnce && milliseconds(start) + rest >= left;
      done[i] = !late;
      bring_up(context, rows[i], late, workers[thread]);
    }
  });
  left_ = static_cast<int64_t>(std::count(done.begin(), done.end(), 0));
  int64_t put_off = 0;
  double put_off_ms = 0;
  for (const FieldWorker& worker : workers) put_off += worker.put_off, put_off_ms += worker.put_off_ms;
  if (put_off > 0) put_off_ms_ = put_off_ms / static_cast<double>(put_off);
  for (const FieldWorker& worker : workers) stats.recomputed_blocks += worker.blocks, stats.computed_voxels += worker.voxels;
  stats.transform_ms = milliseconds(start);
}

void Esdf::forget_changes() {
  for (const auto& block : blocks_) {
    if (!block->touched) continue;
    block->touched = false;
    std::fill_n(block->gone, kSide, 0);
    make_leaves({}, kMostThatCame, slack_, block->arrived);
  }
  for (const auto& block : erased_) {
    slots_[block->slot] = nullptr;
    free_slots_.push_back(block->slot);
  }
  erased_.clear();
}

FieldStats Esdf::update(Context& context, const Deadline& deadline) {
  FieldStats stats{};
  if (tsdf_.revision != revision_ || left_ > 0) {
    auto start = Clock::now();
    find_sites(context, stats);
    stats.sites_ms = milliseconds(start);
    start = Clock::now();
    std::vector<int32_t> rows = select(context);
    stats.select_ms = milliseconds(start);
    compute(context, rows, deadline, stats);
    forget_changes();
    revision_ = tsdf_.revision;
  }
  stats.blocks = static_cast<int64_t>(blocks_.size());
  stats.stale_blocks = left_;
  return stats;
}

FieldStats Esdf::recompute(Context& context) {
  for (const auto& block : blocks_) block->anew = true;
  FieldStats stats{};
  std::vector<int32_t> rows = select(context);
  compute(context, rows, {0, nullptr}, stats);
  stats.blocks = static_cast<int64_t>(blocks_.size());
  return stats;
}

void Esdf::clear() {
  table_.clear();
  blocks_.clear(), slots_.clear(), free_slots_.clear(), erased_.clear();
  revision_ = 0, left_ = 0;
}

std::size_t Esdf::bytes() const {
  std::size_t total = table_.bytes() + slots_.capacity() * sizeof(FieldBlock*);
  for (const auto& block : blocks_)
    total += sizeof(FieldBlock) + (block->sites.capacity() + block->tree.sites.capacity()) * sizeof(Site) +
             block->tree.leaves.capacity() * sizeof(Leaf) + block->tree.columns.capacity() * sizeof(float) + block->owners.capacity() * sizeof(uint32_t) +
             (block->voxels ? sizeof(FieldVoxels) : 0);
  return total;
}

}  // namespace ggslam::volumes
