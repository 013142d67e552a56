// SPDX-License-Identifier: Apache-2.0
// The sites of a block in leaves of some that lie beside each other and face the same way: such a leaf is a thin disc,
// whose distance tells more than that of a box.
#include <algorithm>
#include <cmath>

#include "volumes/esdf.hpp"

namespace ggslam::volumes {
namespace {

// Thicker than this, a leaf of more than `kLeastToSplit` sites is split, voxels.
constexpr float kThick = 1.5f;
constexpr std::ptrdiff_t kLeastToSplit = 8;

// Room for so many and a full vector of any instruction set behind them.
std::size_t padded(std::size_t count) { return (count + 31) / 16 * 16; }

Node node_of(const Site* begin, const Site* end, float slack) {
  Vec3f middle = Vec3f::all(0), normal = Vec3f::all(0);
  for (const Site* s = begin; s < end; ++s) {
    middle = middle + Vec3f::from(s->at);
    normal = normal + Vec3f::from(s->normal);
  }
  middle = middle / static_cast<float>(end - begin);
  const float length = std::sqrt(dot(normal, normal));
  normal = length > 1e-3f ? normal / length : Vec3f{{0, 0, 1}};
  float low = 0, high = 0, radius = 0, nearest = 0;
  const Site* within = nullptr;
  for (const Site* s = begin; s < end; ++s) {
    const Vec3f from = Vec3f::from(s->at) - middle;
    const float height = dot(from, normal), cosine = dot(Vec3f::from(s->normal), normal);
    const float rim = s->radius * std::sqrt(std::max(0.0f, 1 - cosine * cosine)), square = dot(from, from);
    const float aside = std::sqrt(std::max(0.0f, square - height * height));
    if (within == nullptr || height - rim < low) low = height - rim;
    if (within == nullptr || height + rim > high) high = height + rim;
    if (within == nullptr || square < nearest) nearest = square, within = s;
    radius = std::max(radius, aside + s->radius);
  }
  Node node;
  (middle + 0.5f * (low + high) * normal).to(node.middle);
  normal.to(node.normal);
  node.radius = radius + slack, node.half = 0.5f * (high - low) + slack;
  std::copy_n(within->at, 3, node.within);
  return node;
}

// The largest component of a normal and its sign: 0 ... 5.
int side_of(const Site& site) {
  int axis = 0;
  for (int a = 1; a < 3; ++a)
    if (std::fabs(site.normal[a]) > std::fabs(site.normal[axis])) axis = a;
  return 2 * axis + (site.normal[axis] < 0);
}

class Splitter {
 public:
  Splitter(std::ptrdiff_t most, float slack, SiteLeaves& out) : most_(most), slack_(slack), out_(out) {}

  void split(Site* begin, Site* end) {
    const Node node = node_of(begin, end, slack_);
    const bool thick = node.half > kThick + slack_ && end - begin > kLeastToSplit;
    Site* middle = end - begin > most_ || thick ? parted(begin, end, thick) : begin;
    if (middle == begin || middle == end) {
      out_.leaves.push_back({node, static_cast<int32_t>(end - out_.sites.data())});
      return;
    }
    split(begin, middle);
    split(middle, end);
  }

 private:
  const std::ptrdiff_t most_;
  const float slack_;
  SiteLeaves& out_;

  // By the side that most do not face, or at the middle of the longest extent.
  static Site* parted(Site* begin, Site* end, bool thick) {
    if (thick) {
      const int side = side_of(*begin);
      Site* middle = std::partition(begin, end, [&](const Site& s) { return side_of(s) == side; });
      if (middle != end) return middle;
    }
    float low[3], high[3];
    for (int a = 0; a < 3; ++a) {
      const auto [least, most] =
          std::minmax_element(begin, end, [a](const Site& p, const Site& q) { return p.at[a] < q.at[a]; });
      low[a] = least->at[a], high[a] = most->at[a];
    }
    int axis = 0;
    for (int a = 1; a < 3; ++a)
      if (high[a] - low[a] > high[axis] - low[axis]) axis = a;
    const float at = 0.5f * (low[axis] + high[axis]);
    return std::partition(begin, end, [&](const Site& s) { return s.at[axis] < at; });
  }
};

}  // namespace

void make_leaves(const std::vector<Site>& sites, std::ptrdiff_t most, float slack, SiteLeaves& out) {
  out.sites = sites;
  out.leaves.clear();
  if (sites.empty()) return;
  Splitter(most, slack, out).split(out.sites.data(), out.sites.data() + out.sites.size());
  out.stride = padded(sites.size());
  out.columns.assign(kSiteColumns * out.stride, 0);
  for (std::size_t i = 0; i < out.sites.size(); ++i) {
    const Site& s = out.sites[i];
    const float row[kSiteColumns] = {s.at[0], s.at[1], s.at[2], s.normal[0], s.normal[1], s.normal[2], s.radius};
    for (int c = 0; c < kSiteColumns; ++c) out.columns[c * out.stride + i] = row[c];
  }
}

void NodeTable::clear(std::size_t room) {
  room_ = padded(room);
  if (values_.size() < NodeColumns::kColumns * room_) values_.resize(NodeColumns::kColumns * room_);
  numbers_.clear(), at_.clear();
}

void NodeTable::add(const Node& node, BlockCoordinates at, int32_t number) {
  at_.resize(3 * room_);
  const std::size_t i = numbers_.size();
  at_[i] = at.x, at_[room_ + i] = at.y, at_[2 * room_ + i] = at.z;
  float* to = values_.data() + i;
  for (int a = 0; a < 3; ++a) {
    to[a * room_] = node.middle[a], to[(3 + a) * room_] = node.normal[a], to[(8 + a) * room_] = node.within[a];
  }
  to[6 * room_] = node.radius, to[7 * room_] = node.half;
  numbers_.push_back(number);
}

void NodeTable::add(const NodeTable& from, int i, const float shift[3]) {
  float* to = values_.data() + numbers_.size();
  for (int c = 0; c < NodeColumns::kColumns; ++c) {
    const float moved = c < 3 ? shift[c] : c >= 8 ? shift[c - 8] : 0.0f;
    to[c * room_] = from.values_[c * from.room_ + i] + moved;
  }
  numbers_.push_back(from.numbers_[i]);
}

NodeColumns NodeTable::columns() const {
  NodeColumns out{};
  for (int a = 0; a < 3; ++a) out.at[a] = at_.empty() ? nullptr : at_.data() + a * room_;
  out.first = values_.data(), out.stride = room_;
  out.count = count();
  return out;
}

}  // namespace ggslam::volumes
