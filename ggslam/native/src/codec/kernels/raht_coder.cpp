// SPDX-License-Identifier: Apache-2.0
// Attributes by the region-adaptive hierarchical transform (ISO/IEC 23090-9, first edition; de Queiroz and Chou, IEEE
// Trans. Image Processing 2016; prediction: Lasserre and Flynn, 2019), from the root down: the encoder reconstructs as
// it goes, so both directions are the same walk.
#include <algorithm>
#include <cstdlib>
#include <utility>

#include "codec/gpcc.hpp"
#include "codec/kernels/coefficient_coder.hpp"
#include "codec/kernels/quantiser.hpp"
#include "codec/kernels/raht_prediction.hpp"
#include "codec/kernels/stream_decoder.hpp"

namespace ggslam::GGSLAM_ISA {
namespace codec {
namespace {

using gpcc::Octree;
using gpcc::RahtSettings;
using gpcc::Status;

// Sums of the attribute below each node of each level, entry 0 unused: what an encoder transforms.
using LevelSums = std::vector<std::vector<std::int64_t>>;

// `below` has the sums of the children, the first one that of child `first`.
template <int Components, class Value>
void sum_children(const Level& level, const Value* below, std::uint32_t first, std::vector<std::int64_t>& sums) {
  sums.assign((level.size() + std::size_t{1}) * Components, 0);
  for (std::uint32_t node = 1; node <= level.size(); ++node) {
    const Value* child = below + static_cast<std::size_t>(level.first_child[node] - first) * Components;
    std::int64_t* here = &sums[static_cast<std::size_t>(node) * Components];
    for (int i = __builtin_popcount(level.occupancy[node]); i > 0; --i, child += Components)
      for (int k = 0; k < Components; ++k) here[k] += child[k];
  }
}

// Coder is CoefficientWriter or CoefficientReader.
template <class Coder, int Components>
class Transform {
 public:
  // `attributes` [points, Components] in the order of the points: read by the encoder, written with what a decoder
  // reconstructs by both.
  Transform(const RahtSettings& settings, const Octree& tree, Coder& coder, std::int32_t* attributes)
      : settings_(settings), tree_(tree), coder_(coder), attributes_(attributes),
        weights_(weight_tables(settings.first_version != 0)), quantiser_(settings, 0), max_value_((std::int64_t{1} << settings.bit_depth) - 1),
        leaf_depth_(tree.depth()), leaves_are_points_(tree.leaf_points.empty()) {}

  Status run() {
    if (Coder::kEncoder) sum_points();
    if (tree_.leaves == 1) {
      code_single_position();
    } else {
      int root = 0;
      while (root + 1 < tree_.depth() && tree_.levels[root + 1].size() == 1) ++root;
      begin_parents(1);
      code_root(root);
      for (int depth = root + 1; depth < tree_.depth(); ++depth) {
        if (settings_.layers > 0) quantiser_ = Quantiser(settings_, depth - root);
        std::swap(parent_values_, values_);
        std::swap(parent_scaled_, scaled_);
        std::swap(parent_links_, links_);
        std::swap(parent_found_, found_);
        if (!code_level(depth)) return gpcc::kTruncated;
      }
    }
    if (!leaves_are_points_) write_points();
    return coder_.failed() ? gpcc::kTruncated : gpcc::kOk;
  }

 private:
  using Values = BlockValues<Components>;

  void sum_points() {
    sums_.resize(tree_.levels.size() + 1);
    if (leaves_are_points_) {
      sum_children<Components>(tree_.levels.back(), attributes_, 1, sums_[leaf_depth_ - 1]);
    } else {
      std::vector<std::int64_t>& leaves = sums_.back();
      leaves.assign((tree_.leaves + std::size_t{1}) * Components, 0);
      const std::int32_t* point = attributes_;
      for (std::uint32_t leaf = 1; leaf <= tree_.leaves; ++leaf)
        for (std::uint32_t i = tree_.weight_of_leaf(leaf); i > 0; --i, point += Components)
          for (int k = 0; k < Components; ++k) leaves[at(leaf) + k] += point[k];
    }
    for (int depth = leaf_depth_ - 1 - leaves_are_points_; depth >= 0; --depth)
      sum_children<Components>(tree_.levels[depth], sums_[depth + 1].data(), 0, sums_[depth]);
  }

  static std::size_t at(std::uint32_t node) { return static_cast<std::size_t>(node) * Components; }

  bool is_leaf_level(int depth) const { return depth == leaf_depth_; }

  // The sum of component k below a child at a depth.
  std::int64_t child_sum(int depth, std::uint32_t child, int k) const {
    return is_leaf_level(depth) && leaves_are_points_ ? attributes_[at(child - 1) + k] : sums_[depth][at(child) + k];
  }

  void begin_parents(std::uint32_t count) {
    links_.clear(count);
    found_.assign(count + 1, 0);
  }

  // A sum over `weight` points as the transform's input: divided by sqrt(weight).
  std::int64_t normalised_sum(std::int64_t sum, std::uint32_t weight) const {
    if (weight == 1) return sum << kFractionBits;
    const WeightRoots roots = weights_.roots(weight);
    return multiply((sum << kFractionBits) >> roots.shift, roots.inverse);
  }

  std::uint32_t weight_of(int depth, std::uint32_t child) const {
    return is_leaf_level(depth) ? tree_.weight_of_leaf(child) : tree_.levels[depth].weight[child];
  }

  // All points at one place: their DC coefficient, then the chain of the duplicates.
  void code_single_position() {
    values_.assign(2 * Components, 0);
    scaled_.assign(2 * Components, 0);
    const std::uint32_t weight = tree_.weight_of_leaf(1);
    Values source{}, result{};
    for (int k = 0; k < Components; ++k)
      if (Coder::kEncoder) source.v[0][k] = normalised_sum(child_sum(leaf_depth_, 1, k), weight);
    code_coefficient(source.v[0], result.v[0], false);
    keep(leaf_depth_, 1, weight, result.v[0]);
  }

  void code_root(int depth) {
    const Level& level = tree_.levels[depth];
    begin_parents(1);
    found_[1] = kFoundAtRoot;
    begin_children(depth);
    const BlockPlan& plan = block_plans().of[level.occupancy[1]];
    std::uint32_t weights[8];
    Values source, result{};
    load_children(depth, 1, plan, weights, source);
    const BlockTransform transform(plan, weights, weights_);
    if (Coder::kEncoder) transform.forward(source);
    code_coefficient(source.v[0], result.v[0]);
    code_details(plan, source, result);
    transform.inverse(result);
    keep_children(depth, 1, plan, weights, result);
  }

  void begin_children(int depth) {
    if (is_leaf_level(depth + 1) && leaves_are_points_) return;
    const std::uint32_t count = is_leaf_level(depth + 1) ? tree_.leaves : tree_.levels[depth + 1].size();
    values_.resize(at(count + 1));
    scaled_.resize(at(count + 1));
  }

  bool code_level(int depth) {
    const Level &parents = tree_.levels[depth - 1], &here = tree_.levels[depth];
    begin_parents(here.size());
    begin_children(depth);
    Links alone{};
    std::uint32_t index = 0;
    for (std::uint32_t parent = 1; parent <= parents.size(); ++parent) {
      const bool search = settings_.prediction && parent_found_[parent] >= settings_.min_parent_neighbours;
      const Links* links = nullptr;
      std::uint64_t window = 0;
      if (search) {
        links = &parent_links_.of(parent, alone);
        window = parent_links_.has(parent) ? window_of(*links, parents.occupancy.data())
                                           : window_alone(parents.occupancy[parent]);
      }
      for (unsigned rest = parents.occupancy[parent]; rest != 0; rest &= rest - 1) {
        ++index;
        const int octant = __builtin_ctz(rest);
        std::uint64_t neighbours = 0;
        if (search) {
          const std::uint64_t around = window >> window_shift(octant) & kAround19;
          if (!is_leaf_level(depth + 1) && around != std::uint64_t{1} << kCentreBit)
            link(*links, parents, octant, around, links_.add(index));
          neighbours = around & prediction_tables().relevant[here.occupancy[index]];
          found_[index] = static_cast<std::uint8_t>(1 + __builtin_popcountll(neighbours));
        }
        const bool predicted = search && found_[index] >= settings_.min_neighbours;
        code_block(depth, index, predicted ? links : nullptr, octant, neighbours);
      }
      if (coder_.failed() || links_.used() > gpcc::kMaxLinked) return false;
    }
    return true;
  }

  void code_block(int depth, std::uint32_t node, const Links* parent_links, int octant, std::uint64_t neighbours) {
    const unsigned occupancy = tree_.levels[depth].occupancy[node];
    const BlockPlan& plan = block_plans().of[occupancy];
    std::uint32_t weights[8];
    Values source, result{};
    const std::int32_t* dc = &parent_scaled_[at(node)];
    if (plan.slots > 1) {
      load_children(depth, node, plan, weights, source);
      const BlockTransform transform(plan, weights, weights_);
      if (Coder::kEncoder) transform.forward(source);
      if (parent_links != nullptr) {
        predict(depth, node, plan, occupancy, *parent_links, octant, neighbours, weights, result);
        transform.forward(result);
      }
      code_details(plan, source, result);
      inherit(dc, result);
      transform.inverse(result);
    } else {
      weights[0] = weight_of(depth + 1, tree_.levels[depth].first_child[node]);
      inherit(dc, result);
    }
    keep_children(depth, node, plan, weights, result);
  }

  static void inherit(const std::int32_t* dc, Values& result) {
    for (int k = 0; k < Components; ++k) result.v[0][k] = static_cast<std::int64_t>(dc[k]) << (kFractionBits - kKeptBits);
  }

  void predict(int depth, std::uint32_t node, const BlockPlan& plan, unsigned occupancy, const Links& parent_links,
               int octant, std::uint64_t neighbours, const std::uint32_t* weights, Values& out) const {
    const Level& parents = tree_.levels[depth - 1];
    const int shift = window_shift(octant);
    predict_children<Components>(
        plan, occupancy, neighbours, &parent_values_[at(node)], parent_values_.data(),
        [&](int bit) { return node_at(parent_links, parents, bit + shift); }, out);
    for (int slot = 0; slot < plan.slots; ++slot) {
      if (weights[slot] == 1) continue;
      const std::int64_t root = weights_.roots(weights[slot]).root;
      for (int k = 0; k < Components; ++k) out.v[slot][k] = multiply(out.v[slot][k], root);
    }
  }

  void load_children(int depth, std::uint32_t node, const BlockPlan& plan, std::uint32_t* weights, Values& source) const {
    const std::uint32_t first = tree_.levels[depth].first_child[node];
    for (int slot = 0; slot < plan.slots; ++slot) {
      weights[slot] = weight_of(depth + 1, first + slot);
      if (!Coder::kEncoder) continue;
      for (int k = 0; k < Components; ++k)
        source.v[slot][k] = normalised_sum(child_sum(depth + 1, first + slot, k), weights[slot]);
    }
  }

  void keep_children(int depth, std::uint32_t node, const BlockPlan& plan, const std::uint32_t* weights,
                     const Values& result) {
    const std::uint32_t first = tree_.levels[depth].first_child[node];
    for (int slot = 0; slot < plan.slots; ++slot) keep(depth + 1, first + slot, weights[slot], result.v[slot]);
  }

  // Notes a reconstructed node: as the DC coefficient of its own block, and normalised, as a value to predict from. A
  // leaf of one point is done.
  void keep(int depth, std::uint32_t child, std::uint32_t weight, const std::int64_t* value) {
    if (is_leaf_level(depth) && leaves_are_points_) {
      for (int k = 0; k < Components; ++k) attributes_[at(child - 1) + k] = clipped(rounded(value[k]));
      return;
    }
    std::int32_t *scaled = &scaled_[at(child)], *normalised = &values_[at(child)];
    for (int k = 0; k < Components; ++k) scaled[k] = static_cast<std::int32_t>(rounded(value[k] << kKeptBits));
    if (weight == 1) {
      for (int k = 0; k < Components; ++k) normalised[k] = static_cast<std::int32_t>(rounded(value[k]));
      return;
    }
    const WeightRoots roots = weights_.roots(weight);
    for (int k = 0; k < Components; ++k)
      normalised[k] = static_cast<std::int32_t>(rounded(multiply(value[k] >> roots.shift, roots.inverse)));
  }

  void code_details(const BlockPlan& plan, const Values& source, Values& result) {
    for (int i = 0; i + 1 < plan.slots; ++i) code_coefficient(source.v[plan.scan[i]], result.v[plan.scan[i]]);
  }

  // Codes the difference of a coefficient from its prediction and adds it to the latter.
  void code_coefficient(const std::int64_t* source, std::int64_t* result, bool droppable = true) {
    Coefficients<Components> q;
    if constexpr (Coder::kEncoder) {
      std::int64_t difference[Components];
      for (int k = 0; k < Components; ++k) {
        difference[k] = rounded(source[k] - result[k]);
        q.c[k] = quantiser_.quantise(difference[k], k);
      }
      if (droppable && settings_.rdoq > 0 && !q.zero() && is_cheap(difference, q)) q = {};
    }
    coder_.code(q);
    for (int k = 0; k < Components; ++k) result[k] += quantiser_.restored(q.c[k], k) << kFractionBits;
  }

  // Whether small coefficients cost more bits than the error they save is worth. The rule, with the settings' weight of
  // 1, is the reference encoder's: its streams are the same to the byte.
  bool is_cheap(const std::int64_t* difference, const Coefficients<Components>& q) const {
    static constexpr int kBits[3] = {0, 256, 405};  // of a size, in 1/256
    std::int64_t sum = 0, error = 0;
    int bits = 128;
    for (int k = 0; k < Components; ++k) {
      const std::int64_t size = std::abs(static_cast<std::int64_t>(q.c[k]));
      if ((sum += size) > 2) return false;
      bits += kBits[size];
      error += difference[k] * difference[k];
    }
    return (error << 26) < quantiser_.weighted_bits(run_bits(coder_.run()) + (bits >> 8), Components);
  }

  std::int32_t clipped(std::int64_t value) const {
    return static_cast<std::int32_t>(std::clamp<std::int64_t>(value, 0, max_value_));
  }

  // The leaves of a tree with duplicates: those of one point have their value, the others are split into their points.
  void write_points() {
    std::int32_t* point = attributes_;
    for (std::uint32_t leaf = 1; leaf <= tree_.leaves; ++leaf) {
      const std::uint32_t count = tree_.weight_of_leaf(leaf);
      if (count == 1) {
        for (int k = 0; k < Components; ++k) point[k] = clipped(values_[at(leaf) + k]);
      } else {
        split_duplicates(leaf, count, point);
        if (coder_.failed()) return;
      }
      point += at(count);
    }
  }

  // Takes the points off one by one, the last one first: each time a transform of two values with weights w and 1.
  void split_duplicates(std::uint32_t leaf, std::uint32_t count, std::int32_t* point) {
    const std::int32_t* mean = &values_[at(leaf)];
    const std::int64_t root = weights_.roots(count).root;
    Values rest{}, source{};
    for (int k = 0; k < Components; ++k) rest.v[0][k] = multiply(static_cast<std::int64_t>(mean[k]) << kFractionBits, root);
    std::int64_t sum[Components];
    if (Coder::kEncoder)
      for (int k = 0; k < Components; ++k) sum[k] = sums_.back()[at(leaf) + k];
    for (std::uint32_t w = count - 1; w > 0; --w) {
      const Butterfly f = weights_.butterfly(w, 1);
      std::int32_t* taken = point + at(w);
      std::int64_t detail[Components] = {};
      if (Coder::kEncoder)
        for (int k = 0; k < Components; ++k) {
          sum[k] -= taken[k];
          source.v[0][k] = multiply(static_cast<std::int64_t>(taken[k]) << kFractionBits, f.a) -
                           multiply(normalised_sum(sum[k], w), f.b);
        }
      code_coefficient(source.v[0], detail, false);
      for (int k = 0; k < Components; ++k) {
        const std::int64_t low = rest.v[0][k], high = detail[k];
        taken[k] = clipped(rounded(multiply(low, f.b) + multiply(high, f.a)));
        rest.v[0][k] = multiply(low, f.a) - multiply(high, f.b);
        if (w == 1) point[k] = clipped(rounded(rest.v[0][k]));
      }
      if (coder_.failed()) return;
    }
  }

  static constexpr int kKeptBits = 2;         // fractional bits of an inherited DC coefficient
  static constexpr std::uint8_t kFoundAtRoot = 19;

  const RahtSettings& settings_;
  const Octree& tree_;
  Coder& coder_;
  std::int32_t* attributes_;
  const WeightTables& weights_;
  Quantiser quantiser_;
  const std::int64_t max_value_;
  const int leaf_depth_;
  const bool leaves_are_points_;
  LevelSums sums_;
  std::vector<std::int32_t> parent_values_, values_;  // normalised reconstruction of the nodes of a level
  std::vector<std::int32_t> parent_scaled_, scaled_;  // the same times the root of the weight, with kKeptBits
  LinkTable parent_links_, links_;
  std::vector<std::uint8_t> parent_found_, found_;    // neighbours found, the block itself among them; 0: not searched
};

template <int Components>
Status encode(const RahtSettings& settings, const Octree& tree, std::int32_t* attributes, std::vector<std::uint8_t>& out) {
  BinaryEncoder coder(out);
  CoefficientWriter<Components> writer(coder);
  const Status status = Transform<CoefficientWriter<Components>, Components>(settings, tree, writer, attributes).run();
  writer.finish();
  coder.finish();
  return status;
}

template <int Components>
Status decode(const RahtSettings& settings, const Octree& tree, const std::uint8_t* data, std::size_t size,
              gpcc::Memory& memory, std::int32_t* attributes) {
  if (settings.separate_bits != 0 || settings.index >= 0) {
    StreamDecoder coder(data, size, settings.separate_bits != 0);
    CoefficientReader<Components, StreamDecoder> reader(coder);
    memory.load(reader.model());
    const Status status = Transform<decltype(reader), Components>(settings, tree, reader, attributes).run();
    memory.save(reader.model());
    return status;
  }
  BinaryDecoder coder(data, size);
  CoefficientReader<Components> reader(coder);
  return Transform<CoefficientReader<Components>, Components>(settings, tree, reader, attributes).run();
}

}  // namespace
}  // namespace codec

gpcc::Status raht_encode(const gpcc::RahtSettings& settings, const gpcc::Octree& tree, std::int32_t* attributes,
                         std::vector<std::uint8_t>& out) {
  return settings.components == 1 ? codec::encode<1>(settings, tree, attributes, out)
                                  : codec::encode<3>(settings, tree, attributes, out);
}

gpcc::Status raht_decode(const gpcc::RahtSettings& settings, const gpcc::Octree& tree, const std::uint8_t* data,
                         std::size_t size, gpcc::Memory& memory, std::int32_t* attributes) {
  return settings.components == 1 ? codec::decode<1>(settings, tree, data, size, memory, attributes)
                                  : codec::decode<3>(settings, tree, data, size, memory, attributes);
}

}  // namespace ggslam::GGSLAM_ISA
