// SPDX-License-Identifier: Apache-2.0
// The nearest discs of the voxels of a block: what may matter is listed for a part of it, then tried for its packets.
#include <algorithm>
#include <vector>

#include "volumes/kernels/esdf_search.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

struct BlockMemory {
  std::vector<float> scratch;
  std::vector<int32_t> found;
  NearSites missed;  // of the block
  PacketMemory packet;
};

class BlockSearch {
 public:
  BlockSearch(const NearestInput& in, FieldVoxels& out, BlockMemory& memory)
      : in_(in), out_(out), packet_(in, out, memory.packet), scratch_(memory.scratch), found_(memory.found),
        all_(memory.packet.all), arrived_(memory.packet.arrived), missed_(memory.missed) {
    scratch_.resize(in.all.count + kLanes), found_.resize(in.all.count);
    missed_.clear();
    for (int32_t i = 0; i < in.missed_count; ++i) {
      int shift[3];
      packet_.shift_of(in.missed[i].at, shift);
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
    return {largest(farthest) / in_.voxel, packet_.computed()};
  }

 private:
  const NearestInput& in_;
  FieldVoxels& out_;
  PacketSearch packet_;
  std::vector<float>& scratch_;
  std::vector<int32_t>& found_;
  NearGroups& all_;
  NearSites &arrived_, &missed_;

  static bool any_in_part(const uint64_t* words, int x, int y, int z) {
    uint64_t any = 0;
    for (int k = 0; k < kPart; ++k) any |= words[z + k];
    return (any >> (kSide * y) & 0xffffffffu & 0x0f0f0f0fu << x) != 0;
  }

  template <class Do>
  static void each_packet(int x, int y, int z, const Do& f) {
    for (int k = 0; k < kPart; k += kDeep)
      for (int j = 0; j < kPart; j += kHigh)
        for (int i = 0; i < kPart; i += kWide) f(x + i, y + j, z + k);
  }

  void search_part(int x, int y, int z) {
    if (!any_in_part(in_.known, x, y, z)) return;
    arrived_.clear(), all_.clear();
    if (in_.arrived.count > 0 || !missed_.empty()) list_arrived(x, y, z);
    const bool searches = any_in_part(in_.search, x, y, z);
    if (!searches && arrived_.empty() && !any_in_part(in_.redo, x, y, z)) return;
    if (searches) list_all(x, y, z);
    each_packet(x, y, z, [&](int i, int j, int k) { packet_.search(i, j, k); });
  }

  void list_all(int x, int y, int z) {
    const float half = 0.5f * (kPart - 1), middle[3] = {x + half, y + half, z + half};
    const int n = nodes_near(in_.all, middle, kPartReach, in_.max_distance, scratch_.data(), found_.data());
    all_.reserve(n);
    for (int i = 0; i < n; ++i) all_.add(in_.all, in_.all_numbers, found_[i]);
  }

  // Those that came or moved and may be nearer than what voxels of a part had.
  void list_arrived(int x, int y, int z) {
    Reach reach{};
    const int first[3] = {x, y, z};
    for (int a = 0; a < 3; ++a) reach.half[a] = 0.5f * (kPart - 1), reach.middle[a] = first[a] + reach.half[a];
    reach.most = kNoReach;
    each_packet(x, y, z, [&](int i, int j, int k) { packet_.include(i, j, k, reach); });
    if (reach.most == kNoReach) return;
    const Discs nodes{in_.arrived.first, in_.arrived.stride, in_.arrived.count};
    for (int i = 0; i < nodes.count; i += kLanes)
      for (uint32_t left = packet_.near_nodes(reach, nodes, i); left != 0; left &= left - 1)
        list_arrived(in_.arrivals[in_.arrived_numbers[i + __builtin_ctz(left)]], reach);
    for (int i = 0; i < missed_.count(); i += kLanes)
      for (uint32_t left = packet_.near_sites(reach, missed_.discs(), kHere, i); left != 0; left &= left - 1) {
        const Holder& holder = missed_.site(i + __builtin_ctz(left));
        arrived_.add(holder.site, holder.owner, holder.shift);
      }
  }

  void list_arrived(const SiteGroup& group, const Reach& reach) {
    int shift[3];
    packet_.shift_of(group.at, shift);
    for (int32_t i = 0; i < group.count; i += kLanes)
      for (uint32_t left = packet_.near_sites(reach, discs_of(group), shift, i); left != 0; left &= left - 1) {
        const Site& site = group.sites[i + __builtin_ctz(left)];
        arrived_.add(&site, group.first + static_cast<uint32_t>(site.voxel), shift);
      }
  }
};

}  // namespace

NearestOutput esdf_nearest(const NearestInput& in, FieldVoxels& out) {
  thread_local BlockMemory memory;
  return BlockSearch(in, out, memory).run();
}

}  // namespace ggslam::GGSLAM_ISA
