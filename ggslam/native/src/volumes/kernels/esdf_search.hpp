// SPDX-License-Identifier: Apache-2.0
// The nearest discs of a packet of neighbouring voxels.
//
// Every voxel has the disc that is nearest by the rounded formula below; of discs at the same distance, the one whose
// voxel has the lower z, then y, then x. So the result depends on the sites alone, not on the order in which they are
// tried nor on what was known before; and as no product is fused with a sum, it is the same with all instruction sets.
// What is not tried is farther by the bounds of nodes, which are wider than roundings.
#pragma once
#include <algorithm>
#include <cmath>
#include <vector>

#include "volumes/kernels/esdf_packets.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

// What one search leaves to the next, so that memory is not asked for again.
struct PacketMemory {
  NearGroups all;               // of the part of the block that the packet is in
  NearSites arrived;            // of the part, too
  std::vector<Holder> holders;  // all that were the nearest one of a lane at some time
  std::vector<Holder> recent;   // of the last packet that searched
};

class PacketSearch {
 public:
  PacketSearch(const NearestInput& in, FieldVoxels& out, PacketMemory& memory)
      : in_(in), out_(out), all_(memory.all), arrived_(memory.arrived), holders_(memory.holders),
        recent_(memory.recent) {
    for (int lane = 0; lane < kLanes; ++lane) {
      offset_[0][lane] = static_cast<float>(lane % kWide);
      offset_[1][lane] = static_cast<float>(lane / kWide % kHigh);
      offset_[2][lane] = static_cast<float>(lane / (kWide * kHigh));
    }
    recent_.clear();
  }

  // Of voxels, over all packets.
  int32_t computed() const { return computed_; }

  // The packet whose first voxel is (x, y, z).
  void search(int x, int y, int z) {
    known_ = lanes_of(in_.known, x, y, z);
    const uint32_t search = lanes_of(in_.search, x, y, z) & known_, redo = lanes_of(in_.redo, x, y, z) & known_;
    if (known_ == 0 || (search == 0 && redo == 0 && arrived_.empty())) return;
    constexpr int kWidths[3] = {kWide, kHigh, kDeep};
    const int first[3] = {x, y, z}, row = go_to_packet(x, y, z);
    for (int a = 0; a < 3; ++a) {
      reach_.half[a] = 0.5f * (kWidths[a] - 1), reach_.middle[a] = first[a] + reach_.half[a];
    }
    begin(row, search, lanes_of(in_.orphans, x, y, z) & known_, redo);
    if (!arrived_.empty()) {
      if (settled_) ask(known_);
      else slope_before(row, known_, reach_.slope), reach_.most = most_over(square_root(square_), known_, reach_);
      offer_arrived();
    }
    if (!settled_) return;
    const uint32_t asking = search & ~bits(greater_equal(floor_, square_));
    if (asking != 0) {
      ask(asking);
      offer_all(asking);
    }
    const uint32_t changed = search | redo | (known_ & ~equal(before_, owner_));
    if (changed != 0) write(changed, row, lanes_of(in_.negative, x, y, z), search != 0);
  }

  // Widens `reach`, which has a middle, by the lanes of a packet that had a site; the first gives it its slope.
  void include(int x, int y, int z, Reach& reach) {
    const uint32_t had = lanes_of(in_.known, x, y, z) &
                         (~lanes_of(in_.search, x, y, z) | lanes_of(in_.orphans, x, y, z));
    if (had == 0) return;
    const int row = go_to_packet(x, y, z);
    if (reach.most == kNoReach) slope_before(row, had, reach.slope);
    const Float distance = bound_of((Float)load_packet(out_.distance + row));
    reach.most = std::max(reach.most, most_over(distance, had, reach));
  }

  void shift_of(BlockCoordinates at, int shift[3]) const {
    shift[0] = kSide * (at.x - in_.at.x), shift[1] = kSide * (at.y - in_.at.y), shift[2] = kSide * (at.z - in_.at.z);
  }

  // Which of kLanes sites from `i` on may be nearer, places from `shift`.
  uint32_t near_sites(const Reach& reach, const Discs& discs, const int shift[3], int i) const {
    return may_be_nearer(reach, discs, shift, in_.slack, broadcast(in_.slack), i);
  }

  // The same of nodes, which are as wide and thick as they have to be.
  static uint32_t near_nodes(const Reach& reach, const Discs& discs, int i) {
    return may_be_nearer(reach, discs, kHere, 0, load(discs.column(7) + i), i);
  }

 private:
  const NearestInput& in_;
  FieldVoxels& out_;
  int32_t computed_ = 0;
  const NearGroups& all_;
  const NearSites& arrived_;
  std::vector<Holder> &holders_, &recent_;

  // Of the packet at work.
  Float offset_[3], place_[3];      // of the lanes, from its first voxel; from the block's
  Float local_[3];                  // from the first voxel of the block whose sites are tried
  int shift_[3];                    // of that block
  uint32_t known_, keep_, had_;     // lanes that are; that keep their site unless a nearer one came; that had one
  bool settled_;                    // square_ is that of owner_
  bool improved_;                   // a lane has something nearer than when it was last asked
  Reach reach_;                     // of lanes that ask
  Float square_;                    // to the nearest disc so far; before that, a bound; -1: not known
  Float floor_;                     // no site that stayed is nearer; -2: not known
  Int owner_, before_;              // now; what is written down

  // The row of its first voxel.
  int go_to_packet(int x, int y, int z) {
    const int first[3] = {x, y, z};
    for (int a = 0; a < 3; ++a) place_[a] = offset_[a] + static_cast<float>(first[a]);
    return x + kSide * y + kSide * kSide * z;
  }

  // How far lanes are from what they have, at most, but for the slope.
  float most_over(Float distance, uint32_t lanes, const Reach& reach) const {
    for (int a = 0; a < 3; ++a) distance -= (place_[a] - reach.middle[a]) * reach.slope[a];
    return largest(select(mask_of(lanes), distance, broadcast(-3e38f)));
  }

  // The slope of the distance, without its sign, of one of the lanes of the packet at `row`, as it is written down.
  void slope_before(int row, uint32_t lanes, float slope[3]) const {
    const int lane = __builtin_ctz(lanes);
    const int at = row + lane % kWide + lane / kWide % kHigh * kSide + lane / (kWide * kHigh) * kSide * kSide;
    const float scale = (out_.distance[at] < 0 ? -1.0f : 1.0f) / 511.0f;
    for (int a = 0; a < 3; ++a)
      slope[a] = scale * static_cast<float>(static_cast<int>(out_.gradient[at] >> (10 * a) & 1023) - 511);
  }

  // No less than a distance that was written down, in voxels, roundings and all.
  Float bound_of(Float metres) const {
    return minimum(absolute(metres) * (1.00001f / in_.voxel) + 1e-4f, broadcast(in_.max_distance));
  }

  // Offers those that came or moved and may be nearer to some lanes than what they have.
  void offer_arrived() {
    for (int i = 0; i < arrived_.count(); i += kLanes)
      for (uint32_t left = near_sites(reach_, arrived_.discs(), kHere, i); left != 0; left &= left - 1) {
        const Holder& holder = arrived_.site(i + __builtin_ctz(left));
        offer(*holder.site, holder.owner, holder.shift);
      }
  }

  // Offers the groups that may be nearer to some of the lanes than what they have, until they have something as near as
  // it can be.
  void offer_all(uint32_t lanes) {
    for (int i = 0; i < all_.count(); i += kLanes)
      for (uint32_t left = near_nodes(reach_, all_.discs(), i); left != 0; left &= left - 1) {
        improved_ = false;
        offer(in_.groups[all_.number(i + __builtin_ctz(left))]);
        if (!improved_) continue;
        lanes &= ~bits(greater_equal(floor_, square_));
        if (lanes == 0) return;
        ask(lanes);
      }
  }

  // Sets reach_ to what lanes have.
  void ask(uint32_t lanes) {
    alignas(64) int32_t owners[kLanes];
    store_int(owners, owner_);
    const auto owner = static_cast<uint32_t>(owners[__builtin_ctz(lanes)]);
    if (owner == kNobody) std::fill_n(reach_.slope, 3, 0.0f);
    else slope_of(holder_of(owner), reach_.middle, reach_.slope);
    reach_.most = most_over(square_root(maximum(square_, Float{})) * 1.00001f, lanes, reach_);
  }

  // Of the distance from a site's disc at a place.
  static void slope_of(const Holder& holder, const float place[3], float slope[3]) {
    const Site& site = *holder.site;
    Vec3f from;
    for (int a = 0; a < 3; ++a) from[a] = place[a] - static_cast<float>(holder.shift[a]) - site.at[a];
    const Vec3f normal = Vec3f::from(site.normal);
    const float height = dot(from, normal);
    const Vec3f along = from - height * normal;
    const float aside = std::sqrt(dot(along, along));
    const float outside = aside > site.radius ? (aside - site.radius) / aside : 0.0f;
    const Vec3f away = height * normal + outside * along;
    const float length = std::sqrt(dot(away, away));
    ((length > 0 ? 1 / length : 0.0f) * away).to(slope);
  }

  void begin(int row, uint32_t search, uint32_t orphans, uint32_t redo) {
    before_ = load_packet(out_.owner + row);
    keep_ = known_ & ~search;
    had_ = keep_ | orphans;
    // Until it is known better, no farther than was written down, roundings and all.
    const Float most = broadcast(in_.max_distance);
    const Float before = (Float)load_packet(out_.distance + row);
    const Float bound = select(mask_of(keep_), bound_of(before), most);
    // What stayed is not nearer than what was nearest.
    const Float least = maximum(absolute(before) * (0.99999f / in_.voxel) - 1e-4f, Float{});
    floor_ = select(mask_of(orphans), least * least, broadcast(-2.0f));
    square_ = select(mask_of(known_), bound * bound, broadcast(-1.0f));
    settled_ = improved_ = false;
    if (search == 0 && redo == 0) return;
    settle();
    if (search == 0) return;
    for (const Holder& holder : recent_) offer(*holder.site, holder.owner, holder.shift);
  }

  // Gives the lanes what they have, unless something nearer comes.
  void settle() {
    settled_ = true;
    holders_.clear();
    square_ = select(mask_of(known_), broadcast(in_.max_distance * in_.max_distance), broadcast(-1.0f));
    owner_ = broadcast_int(static_cast<int32_t>(kNobody));
    alignas(64) int32_t owners[kLanes];
    store_int(owners, before_);
    for (uint32_t lanes = had_; lanes != 0;) {
      const int32_t number = owners[__builtin_ctz(lanes)];
      lanes &= ~equal(before_, broadcast_int(number));
      const auto owner = static_cast<uint32_t>(number);
      if (owner == kNobody) continue;
      const SiteList& list = in_.slots[owner / kVoxels];
      const Site* site = std::lower_bound(list.sites, list.sites + list.count, static_cast<int32_t>(owner % kVoxels),
                                          [](const Site& s, int32_t voxel) { return s.voxel < voxel; });
      // Of those that went nothing is left; those that moved may be nearest still.
      if (site == list.sites + list.count || site->voxel != static_cast<int32_t>(owner % kVoxels)) continue;
      int shift[3];
      shift_of(list.at, shift);
      offer(*site, owner, shift);
    }
  }

  void go_to(const int shift[3]) {
    std::copy_n(shift, 3, shift_);
    for (int a = 0; a < 3; ++a) local_[a] = place_[a] - static_cast<float>(shift[a]);
  }

  void offer(const Site& site, uint32_t owner, const int shift[3]) {
    go_to(shift);
    offer(site, owner);
  }

  // The sites of a group that may be nearer to some of the lanes that ask.
  void offer(const SiteGroup& group) {
    int shift[3];
    shift_of(group.at, shift);
    bool moved = false;
    for (int32_t s = 0; s < group.count; s += kLanes)
      for (uint32_t left = near_sites(reach_, discs_of(group), shift, s); left != 0; left &= left - 1) {
        if (!moved) go_to(shift);
        moved = true;
        const Site& site = group.sites[s + __builtin_ctz(left)];
        offer(site, group.first + static_cast<uint32_t>(site.voxel));
      }
  }

  // Between the lanes and a site's disc.
  Gap gap_to(const Site& site) const {
    Gap gap;
    for (int a = 0; a < 3; ++a) gap.from[a] = local_[a] - site.at[a];
    gap.height = gap.from[0] * site.normal[0] + gap.from[1] * site.normal[1] + gap.from[2] * site.normal[2];
    const Float square = gap.from[0] * gap.from[0] + gap.from[1] * gap.from[1] + gap.from[2] * gap.from[2];
    gap.aside = square_root(maximum(square - gap.height * gap.height, Float{}));
    return gap;
  }

  void offer(const Site& site, uint32_t owner) {
    Float from[3], normal[3];
    for (int a = 0; a < 3; ++a) from[a] = local_[a] - site.at[a], normal[a] = broadcast(site.normal[a]);
    const Float least = least_square(from, normal, broadcast(site.radius + in_.slack), broadcast(in_.slack));
    if (!any(greater_equal(square_, least))) return;
    if (!settled_) {
      const int shift[3] = {shift_[0], shift_[1], shift_[2]};
      settle();
      go_to(shift);
    }
    const Gap gap = gap_to(site);
    const Float square = gap.square(site);
    const Mask nearer = greater(square_, square);
    uint32_t even = bits(greater_equal(square_, square)) & ~bits(nearer), won = bits(nearer);
    const Holder holder{&site, owner, {shift_[0], shift_[1], shift_[2]}};
    if (even != 0) {
      const Int own = broadcast_int(static_cast<int32_t>(owner));
      for (even &= ~equal(owner_, own); even != 0; even &= even - 1) {
        const int lane = __builtin_ctz(even);
        const auto other = static_cast<uint32_t>(owner_[lane]);
        if (other == kNobody || !comes_before(holder, holder_of(other))) continue;
        owner_[lane] = static_cast<int32_t>(owner);
        won |= 1u << lane;
      }
    }
    if (won == 0) return;
    improved_ = true;
    square_ = select(nearer, square, square_);
    owner_ = select_int(nearer, broadcast_int(static_cast<int32_t>(owner)), owner_);
    holders_.push_back(holder);
  }

  const Holder& holder_of(uint32_t owner) const {
    std::size_t i = holders_.size() - 1;
    while (holders_[i].owner != owner) --i;
    return holders_[i];
  }

  // Distances and gradients of lanes.
  void write(uint32_t lanes, int row, uint32_t behind, bool searched) {
    computed_ += __builtin_popcount(lanes);
    if (searched) recent_.clear();
    const Mask changed = mask_of(lanes);
    const Float sign = select(mask_of(behind), broadcast(-1.0f), broadcast(1.0f));
    const Mask alone = mask_of(equal(owner_, broadcast_int(static_cast<int32_t>(kNobody))));
    const Float distance = select(alone, broadcast(in_.max_distance), square_root(maximum(square_, Float{})));
    Int gradient = broadcast_int(static_cast<int32_t>(kNoGradient));
    alignas(64) int32_t owners[kLanes];
    store_int(owners, owner_);
    while (lanes != 0) {
      const int32_t owner = owners[__builtin_ctz(lanes)];
      const uint32_t own = equal(owner_, broadcast_int(owner));
      lanes &= ~own;
      if (static_cast<uint32_t>(owner) == kNobody) continue;
      const Holder& holder = holder_of(static_cast<uint32_t>(owner));
      go_to(holder.shift);
      gradient = select_int(mask_of(own), gradient_of(*holder.site, distance, sign), gradient);
      if (searched) recent_.push_back(holder);
    }
    const Int metres = (Int)(sign * distance * in_.voxel);
    store_packet(out_.distance + row, select_int(changed, metres, load_packet(out_.distance + row)));
    store_packet(out_.gradient + row, select_int(changed, gradient, load_packet(out_.gradient + row)));
    store_packet(out_.owner + row, select_int(changed, owner_, before_));
  }

  // Of the signed distance from a site's disc, packed.
  Int gradient_of(const Site& site, Float distance, Float sign) const {
    const Gap gap = gap_to(site);
    // So close to the surface, the side that the value tells and that of the disc may differ.
    const Float facing = select(either(greater(broadcast(0.5f), distance), greater_equal(gap.height * sign, Float{})),
                                broadcast(1.0f), broadcast(-1.0f));
    const float radius = site.radius > 0 ? site.radius + kSmoothRim : 0.0f;
    const Mask over = greater_equal(broadcast(radius), gap.aside);
    const Float beyond = maximum(gap.aside - radius, Float{}), outside = beyond / maximum(gap.aside, broadcast(1e-6f));
    const Float scale = sign / maximum(square_root(gap.height * gap.height + beyond * beyond), broadcast(1e-6f));
    Int packed{};
    for (int a = 0; a < 3; ++a) {
      const Float along = gap.from[a] - gap.height * site.normal[a];
      const Float beside = scale * (gap.height * site.normal[a] + outside * along);
      const Float g = clamp(select(over, facing * site.normal[a], beside), broadcast(-1.0f), broadcast(1.0f));
      packed |= truncate(g * 511.0f + 511.5f) << (10 * a);
    }
    return packed;
  }
};

}  // namespace
}  // namespace ggslam::GGSLAM_ISA
