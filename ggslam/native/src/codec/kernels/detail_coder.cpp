// SPDX-License-Identifier: Apache-2.0
// Attributes by the predicting and the lifting transform (ISO/IEC 23090-9, first edition). Decoding only.
#include <algorithm>

#include "codec/gpcc.hpp"
#include "codec/kernels/coefficient_coder.hpp"
#include "codec/kernels/detail_levels.hpp"
#include "codec/kernels/fixed_point.hpp"
#include "codec/kernels/quantiser.hpp"
#include "codec/kernels/stream_decoder.hpp"

namespace ggslam::GGSLAM_ISA {
namespace codec {
namespace {

using gpcc::DetailSettings;
using gpcc::Status;

template <int Components>
class DetailDecoder {
 public:
  using Reader = CoefficientReader<Components, StreamDecoder>;
  DetailDecoder(const DetailSettings& settings, const DetailLevels& levels, const std::vector<DetailPoint>& points,
                Reader& reader, std::int32_t* values)
      : s_(settings), levels_(levels), points_(points), reader_(reader), values_(values),
        max_value_((std::int64_t{1} << settings.bit_depth) - 1) {}

  Status run() {
    if (s_.lifting)
      lift();
    else
      predict();
    return reader_.failed() ? gpcc::kTruncated : gpcc::kOk;
  }

 private:
  using Values = std::array<std::int64_t, Components>;

  // visit(level, begin, end) for each level, the coarsest first.
  template <class Visit>
  void each_level(const Visit& visit) const {
    const std::vector<std::uint32_t>& sizes = levels_.level_sizes;
    for (std::size_t level = 0; level < sizes.size() && !reader_.failed(); ++level)
      visit(static_cast<int>(level), sizes.back() - sizes[level], sizes.back() - (level ? sizes[level - 1] : 0));
  }

  std::int64_t step(int level, int component) const {
    return quantiser_step(s_.layer_qps[std::min(level, s_.layers - 1)][component > 0]);
  }
  std::int64_t component_weight(int level, int component) const {
    return s_.weighted && component > 0 ? s_.component_weights[std::min(level, 31)][component - 1] : 0;
  }
  std::int32_t* value_of(std::uint32_t place) { return values_ + std::size_t{levels_.order[place]} * Components; }
  std::int32_t clipped(std::int64_t value) const {
    return static_cast<std::int32_t>(std::clamp<std::int64_t>(value, 0, max_value_));
  }

  void predict() {
    each_level([&](int level, std::uint32_t begin, std::uint32_t end) {
      for (std::uint32_t i = begin; i < end && !reader_.failed(); ++i) {
        Coefficients<Components> q;
        reader_.code(q);
        const Predictor& predictor = levels_.predictors[i];
        const int mode = may_choose(predictor) ? take_mode(q) : 0;
        const Values predicted = prediction(predictor, mode);
        std::int32_t* value = value_of(i);
        std::int64_t first = 0;
        for (int k = 0; k < Components; ++k) {
          const std::int64_t residual = (q.c[k] * step(level, k) + 128) >> 8;
          value[k] = clipped(predicted[k] + residual + ((component_weight(level, k) * first + 2) >> 2));
          if (k == 0 && s_.weighted) first = residual;
        }
      }
    });
  }

  // Where neighbours differ much, the stream says which of them predicts the point.
  bool may_choose(const Predictor& predictor) {
    if (predictor.count <= 1 || s_.direct_predictors == 0) return false;
    std::int64_t widest = 0;
    for (int k = 0; k < Components; ++k) {
      std::int32_t low = value_of(predictor.neighbour[0])[k], high = low;
      for (int i = 1; i < predictor.count; ++i) {
        low = std::min(low, value_of(predictor.neighbour[i])[k]);
        high = std::max(high, value_of(predictor.neighbour[i])[k]);
      }
      widest = std::max<std::int64_t>(widest, high - low);
    }
    return widest >= std::int64_t{s_.direct_threshold} << std::max(0, s_.bit_depth - 8);
  }

  static int take_bit(std::int32_t& value) {
    const int bit = std::abs(value) & 1;
    value = value < 0 ? -(-value >> 1) : value >> 1;
    return bit;
  }

  // The choice is hidden in the lowest bits of the coefficients. 0: the mean of all, else the neighbour.
  int take_mode(Coefficients<Components>& q) const {
    const int candidates = s_.direct_predictors + !s_.no_average;
    std::int32_t &first = q.c[Components == 3 ? 1 : 0], &second = q.c[Components == 3 ? 2 : 0];
    int mode = 0;
    if (candidates == 4) {
      const int a = take_bit(first), b = take_bit(second);
      mode = Components == 3 ? a << 1 | b : b << 1 | a;
    } else if (candidates == 3) {
      mode = take_bit(first);
      if (mode) mode += take_bit(second);
    } else if (candidates == 2) {
      mode = take_bit(first);
    }
    return mode + s_.no_average;
  }

  Values prediction(const Predictor& predictor, int mode) {
    Values out{};
    if (mode > predictor.count) return out;
    if (mode > 0) {
      for (int k = 0; k < Components; ++k) out[k] = value_of(predictor.neighbour[mode - 1])[k];
      return out;
    }
    std::uint64_t weights[3];
    weigh(predictor, weights);
    for (int i = 0; i < predictor.count; ++i)
      for (int k = 0; k < Components; ++k)
        out[k] += static_cast<std::int64_t>(weights[i]) * value_of(predictor.neighbour[i])[k];
    for (int k = 0; k < Components; ++k) out[k] = half_away(out[k], kWeightBits) & 0xffff;
    return out;
  }

  // Neighbours that lie near to each other share their weights, if the settings say so.
  void weigh(const Predictor& p, std::uint64_t* out) const {
    for (int i = 0; i < 3; ++i) out[i] = p.weight[i];
    if (!s_.blend || p.count != 3) return;
    constexpr int kOwn = 10, kNear = 1, kFar = 5;
    const auto apart = [&](int a, int b) {
      return distance2(points_[levels_.order[p.neighbour[a]]], points_[levels_.order[p.neighbour[b]]]);
    };
    const std::int64_t d01 = apart(0, 1), d02 = apart(0, 2), d12 = apart(1, 2);
    const int b1 = d01 <= d02 ? kNear : kFar, b2 = d01 <= d12 ? kFar : kNear, b3 = d02 <= d12 ? kNear : kFar;
    const int w0 = static_cast<int>(p.weight[0]), w1 = static_cast<int>(p.weight[1]), w2 = static_cast<int>(p.weight[2]);
    const int first = (w0 * kOwn + w1 * (16 - kOwn - b2) + w2 * b3) >> 4;
    const int second = (w0 * b1 + w1 * kOwn + w2 * (16 - kOwn - b3)) >> 4;
    out[0] = static_cast<std::uint32_t>(first);
    out[1] = static_cast<std::uint32_t>(second);
    out[2] = static_cast<std::uint32_t>(256 - first - second);
  }

  // --- lifting

  void lift() {
    const std::size_t count = levels_.order.size();
    const std::vector<std::uint64_t> weights = quantisation_weights();
    std::vector<Values> details(count, Values{});
    each_level([&](int level, std::uint32_t begin, std::uint32_t end) {
      for (std::uint32_t i = begin; i < end && !reader_.failed(); ++i) {
        Coefficients<Components> q;
        reader_.code(q);
        const auto inverse = static_cast<std::int64_t>(inverse_square_root(weights[i]));
        std::int64_t scaled = 0;
        for (int k = 0; k < Components; ++k) {
          const std::int64_t taken = k == 2 ? scaled * component_weight(level, 2) >> 2 : 0;
          scaled = taken + q.c[k] * step(level, k);
          details[i][k] = half_away(scaled * inverse, 36);
        }
      }
    });
    std::vector<std::uint64_t> sums(count);
    std::vector<Values> updates(count);
    each_level([&](int level, std::uint32_t begin, std::uint32_t end) {
      if (level == 0) return;
      take_back_updates(begin, end, weights, sums, updates, details);
      for (std::uint32_t i = begin; i < end; ++i) add_prediction(i, details);
    });
    for (std::uint32_t i = 0; i < count; ++i)
      for (int k = 0; k < Components; ++k) value_of(i)[k] = clipped(half_away(details[i][k], 8));
  }

  std::vector<std::uint64_t> quantisation_weights() const {
    std::vector<std::uint64_t> weights(levels_.order.size(), 1 << kWeightBits);
    for (std::size_t i = 0; i < weights.size(); ++i) {  // the finest level first
      const Predictor& p = levels_.predictors[i];
      for (int j = 0; j < p.count; ++j) weights[p.neighbour[j]] += rounded_product(p.weight[j], weights[i]);
    }
    return weights;
  }
  static std::uint64_t rounded_product(std::uint64_t a, std::uint64_t b) {
    return (a * b + (1 << (kWeightBits - 1))) >> kWeightBits;
  }

  void take_back_updates(std::uint32_t begin, std::uint32_t end, const std::vector<std::uint64_t>& weights,
                         std::vector<std::uint64_t>& sums, std::vector<Values>& updates, std::vector<Values>& details) {
    std::fill(sums.begin() + end, sums.end(), 0);
    std::fill(updates.begin() + end, updates.end(), Values{});
    for (std::uint32_t i = begin; i < end; ++i) {
      const Predictor& p = levels_.predictors[i];
      for (int j = 0; j < p.count; ++j) {
        const std::uint64_t weight = rounded_product(p.weight[j], weights[i]);
        sums[p.neighbour[j]] += weight;
        for (int k = 0; k < Components; ++k)
          updates[p.neighbour[j]][k] += static_cast<std::int64_t>(weight) * details[i][k];
      }
    }
    for (std::size_t i = end; i < details.size(); ++i) {
      const auto sum = static_cast<std::uint32_t>(sums[i]);
      if (sum == 0) continue;
      for (int k = 0; k < Components; ++k) details[i][k] -= divide(updates[i][k], sum, 0);
    }
  }

  void add_prediction(std::uint32_t i, std::vector<Values>& details) const {
    const Predictor& p = levels_.predictors[i];
    Values sum{};
    for (int j = 0; j < p.count; ++j)
      for (int k = 0; k < Components; ++k) sum[k] += static_cast<std::int64_t>(p.weight[j]) * details[p.neighbour[j]][k];
    for (int k = 0; k < Components; ++k) details[i][k] += half_away(sum[k], kWeightBits);
  }

  const DetailSettings& s_;
  const DetailLevels& levels_;
  const std::vector<DetailPoint>& points_;
  Reader& reader_;
  std::int32_t* values_;
  const std::int64_t max_value_;
};

template <int Components>
Status decode_details(const DetailSettings& settings, const DetailLevels& levels, const std::vector<DetailPoint>& points,
                      const std::uint8_t* data, std::size_t size, gpcc::Memory& memory, std::int32_t* values) {
  StreamDecoder coder(data, size, settings.separate_bits != 0);
  CoefficientReader<Components, StreamDecoder> reader(coder);
  memory.load(reader.model());
  const Status status = DetailDecoder<Components>(settings, levels, points, reader, values).run();
  memory.save(reader.model());
  return status;
}

}  // namespace
}  // namespace codec

// Values [count, components] of the points [count, 3]; codes: their Morton codes, rising unless the order is canonical.
gpcc::Status detail_decode(const gpcc::DetailSettings& settings, const std::int32_t* points, const std::uint64_t* codes,
                           std::uint32_t count, const std::uint8_t* data, std::size_t size, gpcc::Memory& memory,
                           std::int32_t* values) {
  std::vector<codec::DetailPoint> all(count);
  for (std::uint32_t i = 0; i < count; ++i)
    all[i] = {points[3 * std::size_t{i}], points[3 * std::size_t{i} + 1], points[3 * std::size_t{i} + 2]};
  const std::vector<std::uint64_t> own_codes(codes, codes + count);
  codec::DetailLevels levels(settings, all, own_codes);
  if (!levels.build()) return gpcc::kTooLarge;
  return settings.components == 1 ? codec::decode_details<1>(settings, levels, all, data, size, memory, values)
                                  : codec::decode_details<3>(settings, levels, all, data, size, memory, values);
}

}  // namespace ggslam::GGSLAM_ISA
