// SPDX-License-Identifier: Apache-2.0
// Predictive geometry (ISO/IEC 23090-9, first edition), without the angular mode: trees of points, each predicted from
// its ancestors. Decoding only.
#include <algorithm>

#include "codec/gpcc.hpp"
#include "codec/kernels/exp_golomb.hpp"
#include "codec/kernels/stream_decoder.hpp"

namespace ggslam::GGSLAM_ISA {
namespace codec {
namespace {

using gpcc::PredictiveSettings;
using gpcc::Status;

struct PredictiveContexts {
  Probability children[3], mode[3], not_zero[3], sign[3], bits[5][3][31], duplicates, more_duplicates;
  Probability qp_offset, qp_sign, qp_rest, last_tree;
};

class PredictiveDecoder {
 public:
  PredictiveDecoder(const PredictiveSettings& settings, StreamDecoder& coder, std::uint32_t max_points,
                    std::vector<std::int32_t>& out)
      : s_(settings), coder_(coder), max_points_(max_points), out_(out) {}

  PredictiveContexts& contexts() { return c_; }

  Status run() {
    do {
      const Status status = decode_tree();
      if (status != gpcc::kOk) return status;
    } while (!coder_.code(0, c_.last_tree));
    if (coder_.failed()) return gpcc::kTruncated;
    return points() == max_points_ ? gpcc::kOk : gpcc::kCountMismatch;
  }

 private:
  static constexpr std::int32_t kNone = -1;
  std::uint32_t points() const { return static_cast<std::uint32_t>(out_.size() / 3); }

  // Depth first. `parents_` has an entry for each point, of one with copies for the first.
  Status decode_tree() {
    std::vector<std::int32_t> open{kNone};
    int until_qp = 0;
    step_ = step_of(s_.slice_qp);
    while (!open.empty()) {
      const std::int32_t parent = open.back();
      open.pop_back();
      if (s_.scaling && until_qp-- == 0) {
        step_ = step_of(s_.slice_qp + code_qp_offset());
        until_qp = s_.qp_interval - 1;
      }
      std::uint32_t copies = 0;
      if (!s_.unique_points && coder_.code(0, c_.duplicates))
        copies = 1 + code_exp_golomb(coder_, 0, 0, c_.more_duplicates);
      const int children = code_children();
      std::int32_t position[3];
      if (!decode_position(parent, position) || coder_.failed()) return gpcc::kTruncated;
      if (copies >= max_points_ - points()) return gpcc::kCountMismatch;
      const auto index = static_cast<std::int32_t>(points());
      for (std::uint32_t i = 0; i <= copies; ++i) {
        out_.insert(out_.end(), position, position + 3);
        parents_.push_back(parent);
      }
      if (open.size() + children > max_points_) return gpcc::kCountMismatch;
      open.insert(open.end(), children, index);
    }
    return gpcc::kOk;
  }

  int code_children() {
    int value = coder_.code(0, c_.children[0]);
    if (value == 1) value += coder_.code(0, c_.children[1]);
    if (value == 2) value += coder_.code(0, c_.children[2]);
    return value ^ 1;
  }

  bool decode_position(std::int32_t parent, std::int32_t* position) {
    int mode = coder_.code(0, c_.mode[0]);
    mode = mode << 1 | coder_.code(0, c_.mode[1 + mode]);
    std::int64_t residual[3];
    decode_residual(mode, residual);
    const std::int32_t* from[3] = {};
    for (int i = 0; i < mode; ++i) {
      if (parent == kNone) return false;
      from[i] = &out_[3 * static_cast<std::size_t>(parent)];
      parent = parents_[static_cast<std::size_t>(parent)];
    }
    for (int axis = 0; axis < 3; ++axis) {
      std::int64_t value = (residual[axis] * step_ + 4) >> 3;
      if (mode == 1) value += from[0][axis];
      if (mode == 2) value += 2 * std::int64_t{from[0][axis]} - from[1][axis];
      if (mode == 3) value += std::int64_t{from[0][axis]} + from[1][axis] - from[2][axis];
      if (value >= gpcc::kMaxPosition) return false;
      position[axis] = static_cast<std::int32_t>(std::max<std::int64_t>(value, 0));
    }
    return true;
  }

  void decode_residual(int mode, std::int64_t* residual) {
    int set = 0;
    for (int axis = 0; axis < 3; ++axis) {
      residual[axis] = 0;
      if (!coder_.code(0, c_.not_zero[axis])) continue;
      const int width = s_.residual_bits[axis];
      unsigned place = 1;  // in a binary tree of contexts
      for (int i = 0; i < width; ++i)
        place = place << 1 | static_cast<unsigned>(coder_.code(0, c_.bits[set][axis][std::min(place - 1, 30u)]));
      const int bits = static_cast<int>(place ^ 1u << width);
      if (axis == 0) set = std::min(4, (bits + 1) >> 1);
      std::int64_t size = 1 + bits;
      if (bits > 1) {
        if (bits > 31) {
          coder_.mark_corrupt();
          return;
        }
        size = 1 + (std::int64_t{1} << (bits - 1));
        for (int i = 0; i < bits - 1; ++i) size += static_cast<std::int64_t>(coder_.bypass(0)) << i;
      }
      const bool negative = (mode != 0 || axis != 0) && coder_.code(0, c_.sign[axis]);
      residual[axis] = negative ? -size : size;
    }
  }

  int code_qp_offset() {
    if (!coder_.code(0, c_.qp_offset)) return 0;
    const int size = 1 + static_cast<int>(std::min<std::uint32_t>(code_exp_golomb(coder_, 0, 0, c_.qp_rest), 1 << 16));
    return (coder_.code(0, c_.qp_sign) ? -size : size) * (1 << s_.qp_shift);
  }

  static std::int64_t step_of(int qp) {
    qp = std::clamp(qp, 0, 8 * 20);
    return static_cast<std::int64_t>(8 + qp % 8) << (qp >> 3);
  }

  const PredictiveSettings& s_;
  StreamDecoder& coder_;
  const std::uint32_t max_points_;
  std::vector<std::int32_t>& out_;
  std::vector<std::int32_t> parents_;
  PredictiveContexts c_;
  std::int64_t step_ = 8;
};

}  // namespace
}  // namespace codec

// Decodes `points` points; positions [points, 3] in the order of the stream; `memory` as in tree_decode.
gpcc::Status predictive_decode(const gpcc::PredictiveSettings& settings, const std::uint8_t* data, std::size_t size,
                               std::uint32_t points, gpcc::Memory& memory, std::vector<std::int32_t>& out) {
  codec::StreamDecoder coder(data, size, settings.separate_bits != 0);
  codec::PredictiveDecoder decoder(settings, coder, points, out);
  memory.load(decoder.contexts());
  const gpcc::Status status = decoder.run();
  memory.save(decoder.contexts());
  return status;
}

}  // namespace ggslam::GGSLAM_ISA
