// SPDX-License-Identifier: Apache-2.0
// The nearest discs of the voxels of a block, a packet of neighbouring voxels at a time.
//
// Every voxel has the disc that is nearest by the rounded formula below; of discs at the same distance, the one whose
// voxel has the lower z, then y, then x. So the result depends on the sites alone, not on the order in which they are
// tried nor on what was known before; and as no product is fused with a sum, it is the same with all instruction sets.
// What is not tried is farther by the bounds of nodes, which are wider than roundings.
#include <algorithm>
#include <cmath>
#include <vector>

#include "volumes/kernels/esdf_packets.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

// What one search leaves to the next, so that memory is not asked for again.
struct SearchMemory {
  std::vector<float> scratch;
  std::vector<int32_t> found;
  NearGroups all;                // of the part at work
  NearSites arrived;             // of the part, too
  NearSites missed;              // of the block
  std::vector<Holder> holders;   // of the packet at work: all that were the nearest one at some time
  std::vector<Holder> recent;    // of the last packet that searched
};

class BlockSearch {
 public:
  BlockSearch(const NearestInput& in, FieldVoxels& out, SearchMemory& memory)
      : in_(in), out_(out), scratch_(memory.scratch), found_(memory.found), all_(memory.all), arrived_(memory.arrived),
        missed_(memory.missed), holders_(memory.holders), recent_(memory.recent) {
    for (int lane = 0; lane < kLanes; ++lane) {
      offset_[0][lane] = static_cast<float>(lane % kWide);
      offset_[1][lane] = static_cast<float>(lane / kWide % kHigh);
      offset_[2][lane] = static_cast<float>(lane / (kWide * kHigh));
    }
    scratch_.resize(in.all.count + kLanes), found_.resize(in.all.count);
    recent_.clear(), missed_.clear();
    for (int32_t i = 0; i < in.missed_count; ++i) {
      int shift[3];
      shift_of(in.missed[i].at, shift);
      missed_.add(in.missed[i].site, in.missed[i].owner, shift);
    }
  }

  NearestOutput run() {
    for (int part = 0; part < 8; ++part) search_part(kPart * (part & 1), kPart * (part >> 1 & 1), kPart * (part >> 2));
    Float farthest{};
    for (int row = 0; row < kVoxels; row += kLanes) {
      const Float distance = absolute(load(out_.distance + row));
      farthest = select(greater(distance, farthest), distance, farthest);
    }
    result_.farthest = largest(farthest) / in_.voxel;
    return result_;
  }

 private:
  const NearestInput& in_;
  FieldVoxels& out_;
  NearestOutput result_{0, 0};
  std::vector<float>& scratch_;
  std::vector<int32_t>& found_;
  NearGroups& all_;
  NearSites &arrived_, &missed_;

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
  std::vector<Holder> &holders_, &recent_;

  static uint32_t lanes_of(const uint64_t* words, int x, int y, int z) {
    uint32_t lanes = 0;
    for (int k = 0; k < kDeep; ++k)
      for (int j = 0; j < kHigh; ++j) {
        const uint32_t wide = static_cast<uint32_t>(words[z + k] >> (x + kSide * (y + j))) & ((1u << kWide) - 1);
        lanes |= wide << (kWide * (j + kHigh * k));
      }
    return lanes;
  }

  static bool any_in_part(const uint64_t* words, int x, int y, int z) {
    uint64_t any = 0;
    for (int k = 0; k < kPart; ++k) any |= words[z + k];
    return (any >> (kSide * y) & 0xffffffffu & 0x0f0f0f0fu << x) != 0;
  }

  void search_part(int x, int y, int z) {
    if (!any_in_part(in_.known, x, y, z)) return;
    const bool searches = any_in_part(in_.search, x, y, z);
    arrived_.clear(), all_.clear();
    if (in_.arrived.count > 0 || !missed_.empty()) list_arrived(x, y, z);
    if (!searches && arrived_.empty() && !any_in_part(in_.redo, x, y, z)) return;
    const float half = 0.5f * (kPart - 1), middle[3] = {x + half, y + half, z + half};
    if (searches) {
      const int n = nodes_near(in_.all, middle, kPartReach, in_.max_distance, scratch_.data(), found_.data());
      all_.reserve(n);
      for (int i = 0; i < n; ++i) all_.add(in_.all, in_.all_numbers, found_[i]);
    }
    for (int k = 0; k < kPart; k += kDeep)
      for (int j = 0; j < kPart; j += kHigh)
        for (int i = 0; i < kPart; i += kWide) search_packet(x + i, y + j, z + k);
  }

  // Those that came or moved and may be nearer than what voxels of a part had.
  void list_arrived(int x, int y, int z) {
    Reach reach{};
    const int first[3] = {x, y, z};
    for (int a = 0; a < 3; ++a) reach.half[a] = 0.5f * (kPart - 1), reach.middle[a] = first[a] + reach.half[a];
    bool any = false;
    Float most = broadcast(-3e38f);
    for (int k = z; k < z + kPart; k += kDeep)
      for (int j = y; j < y + kPart; j += kHigh)
        for (int i = x; i < x + kPart; i += kWide) {
          const uint32_t had = lanes_of(in_.known, i, j, k) &
                               (~lanes_of(in_.search, i, j, k) | lanes_of(in_.orphans, i, j, k));
          if (had == 0) continue;
          const int row = i + kSide * j + kSide * kSide * k, corner[3] = {i, j, k};
          if (!any) slope_before(row, had, reach.slope);
          Float places[3];
          for (int a = 0; a < 3; ++a) places[a] = offset_[a] + static_cast<float>(corner[a]);
          Float distance = bound_of((Float)load_packet(out_.distance + row));
          for (int a = 0; a < 3; ++a) distance -= (places[a] - reach.middle[a]) * reach.slope[a];
          most = maximum(most, select(mask_of(had), distance, broadcast(-3e38f)));
          any = true;
        }
    if (!any) return;
    reach.most = largest(most);
    for (int i = 0; i < in_.arrived.count; i += kLanes)
      for (uint32_t left = near_nodes(reach, in_.arrived.column, in_.arrived.count, i); left != 0; left &= left - 1) {
        const SiteGroup& group = in_.arrivals[in_.arrived_numbers[i + __builtin_ctz(left)]];
        int shift[3];
        shift_of(group.at, shift);
        for (int32_t s = 0; s < group.count; s += kLanes)
          for (uint32_t sites = near_sites(reach, group, shift, s); sites != 0; sites &= sites - 1)
            add_arrived(group, s + __builtin_ctz(sites), shift);
      }
    for (int i = 0; i < missed_.count(); i += kLanes)
      for (uint32_t left = near_sites(reach, missed_, i); left != 0; left &= left - 1) {
        const Holder& holder = missed_.site(i + __builtin_ctz(left));
        arrived_.add(holder.site, holder.owner, holder.shift);
      }
  }

  void add_arrived(const SiteGroup& group, int32_t s, const int shift[3]) {
    arrived_.add(group.sites + s, group.first + static_cast<uint32_t>(group.sites[s].voxel), shift);
  }

  // Of kLanes sites of a list from `i` on.
  uint32_t near_sites(const Reach& reach, const NearSites& sites, int i) const {
    Float from[3], normal[3];
    for (int a = 0; a < 3; ++a) {
      from[a] = reach.middle[a] - load(sites.column(a) + i);
      normal[a] = load(sites.column(3 + a) + i);
    }
    const Float radius = load(sites.column(6) + i) + in_.slack;
    const uint32_t near = bits(may_be_nearer(reach, from, normal, radius, broadcast(in_.slack)));
    return sites.count() - i < kLanes ? near & ((1u << (sites.count() - i)) - 1) : near;
  }

  void shift_of(BlockCoordinates at, int shift[3]) const {
    shift[0] = kSide * (at.x - in_.at.x), shift[1] = kSide * (at.y - in_.at.y), shift[2] = kSide * (at.z - in_.at.z);
  }

  // Of kLanes sites of a group from `s` on.
  uint32_t near_sites(const Reach& reach, const SiteGroup& group, const int shift[3], int32_t s) const {
    const float* column = group.columns + s;
    Float from[3], normal[3];
    for (int a = 0; a < 3; ++a) {
      from[a] = (reach.middle[a] - static_cast<float>(shift[a])) - load(column + a * group.stride);
      normal[a] = load(column + (3 + a) * group.stride);
    }
    const Float radius = load(column + 6 * group.stride) + in_.slack;
    const uint32_t near = bits(may_be_nearer(reach, from, normal, radius, broadcast(in_.slack)));
    return group.count - s < kLanes ? near & ((1u << (group.count - s)) - 1) : near;
  }

  // Of kLanes nodes from `i` on.
  static uint32_t near_nodes(const Reach& reach, const float* const* column, int count, int i) {
    Float from[3], normal[3];
    for (int a = 0; a < 3; ++a) from[a] = reach.middle[a] - load(column[a] + i), normal[a] = load(column[3 + a] + i);
    const uint32_t near = bits(may_be_nearer(reach, from, normal, load(column[6] + i), load(column[7] + i)));
    return count - i < kLanes ? near & ((1u << (count - i)) - 1) : near;
  }

  // How far lanes are from what they have, at most, but for the slope.
  static float most_over(const Float places[3], Float distance, uint32_t lanes, const Reach& reach) {
    for (int a = 0; a < 3; ++a) distance -= (places[a] - reach.middle[a]) * reach.slope[a];
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

  void search_packet(int x, int y, int z) {
    known_ = lanes_of(in_.known, x, y, z);
    const uint32_t search = lanes_of(in_.search, x, y, z) & known_, redo = lanes_of(in_.redo, x, y, z) & known_;
    if (known_ == 0 || (search == 0 && redo == 0 && arrived_.empty())) return;
    const int first[3] = {x, y, z}, row = x + kSide * y + kSide * kSide * z, wide[3] = {kWide, kHigh, kDeep};
    for (int a = 0; a < 3; ++a) {
      place_[a] = offset_[a] + static_cast<float>(first[a]);
      reach_.half[a] = 0.5f * (wide[a] - 1), reach_.middle[a] = first[a] + reach_.half[a];
    }
    begin(row, search, lanes_of(in_.orphans, x, y, z) & known_, redo);
    if (!arrived_.empty()) {
      if (settled_) ask(known_);
      else slope_before(row, known_, reach_.slope), reach_.most = most_over(place_, square_root(square_), known_, reach_);
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

  // Offers those that came or moved and may be nearer to some lanes than what they have.
  void offer_arrived() {
    for (int i = 0; i < arrived_.count(); i += kLanes)
      for (uint32_t left = near_sites(reach_, arrived_, i); left != 0; left &= left - 1) {
        const Holder& holder = arrived_.site(i + __builtin_ctz(left));
        offer(*holder.site, holder.owner, holder.shift);
      }
  }

  // Offers the groups that may be nearer to some of the lanes than what they have, until they have something as near as
  // it can be.
  void offer_all(uint32_t lanes) {
    const float* column[8];
    for (int c = 0; c < 8; ++c) column[c] = all_.column(c);
    for (int i = 0; i < all_.count(); i += kLanes)
      for (uint32_t left = near_nodes(reach_, column, all_.count(), i); left != 0; left &= left - 1) {
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
    reach_.most = most_over(place_, square_root(maximum(square_, Float{})) * 1.00001f, lanes, reach_);
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
      for (uint32_t left = near_sites(reach_, group, shift, s); left != 0; left &= left - 1) {
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
    result_.computed += __builtin_popcount(lanes);
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

NearestOutput esdf_nearest(const NearestInput& in, FieldVoxels& out) {
  thread_local SearchMemory memory;
  return BlockSearch(in, out, memory).run();
}

}  // namespace ggslam::GGSLAM_ISA
