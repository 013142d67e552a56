// SPDX-License-Identifier: Apache-2.0
// The adaptive binary range coder of ISO/IEC 23090-9, first edition (that of the Dirac video codec): 16-bit range,
// 16-bit probabilities of a zero. BinaryEncoder and BinaryDecoder have the same interface, so that every model above
// them is written once, as a template: code() is given the bit by the encoder and ignores it in the decoder.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

namespace ggslam::GGSLAM_ISA::codec {

// Adaptation step by the high byte of the probability; index 0 moves by nothing, so probabilities stay in
// [254, 65282] and every coded bit narrows the range.
inline constexpr std::uint16_t kAdaptation[256] = {
    0,    2,    5,    8,    11,   15,   20,   24,   29,   35,   41,   47,   53,   60,   67,   74,   82,   89,   97,
    106,  114,  123,  132,  141,  150,  160,  170,  180,  190,  201,  211,  222,  233,  244,  256,  267,  279,  291,
    303,  315,  327,  340,  353,  366,  379,  392,  405,  419,  433,  447,  461,  475,  489,  504,  518,  533,  548,
    563,  578,  593,  609,  624,  640,  656,  672,  688,  705,  721,  738,  754,  771,  788,  805,  822,  840,  857,
    875,  892,  910,  928,  946,  964,  983,  1001, 1020, 1038, 1057, 1076, 1095, 1114, 1133, 1153, 1172, 1192, 1211,
    1231, 1251, 1271, 1291, 1311, 1332, 1352, 1373, 1393, 1414, 1435, 1456, 1477, 1498, 1520, 1541, 1562, 1584, 1606,
    1628, 1649, 1671, 1694, 1716, 1738, 1760, 1783, 1806, 1828, 1851, 1874, 1897, 1920, 1935, 1942, 1949, 1955, 1961,
    1968, 1974, 1980, 1985, 1991, 1996, 2001, 2006, 2011, 2016, 2021, 2025, 2029, 2033, 2037, 2040, 2044, 2047, 2050,
    2053, 2056, 2058, 2061, 2063, 2065, 2066, 2068, 2069, 2070, 2071, 2072, 2072, 2072, 2072, 2072, 2072, 2071, 2070,
    2069, 2068, 2066, 2065, 2063, 2060, 2058, 2055, 2052, 2049, 2045, 2042, 2038, 2033, 2029, 2024, 2019, 2013, 2008,
    2002, 1996, 1989, 1982, 1975, 1968, 1960, 1952, 1943, 1934, 1925, 1916, 1906, 1896, 1885, 1874, 1863, 1851, 1839,
    1827, 1814, 1800, 1786, 1772, 1757, 1742, 1727, 1710, 1694, 1676, 1659, 1640, 1622, 1602, 1582, 1561, 1540, 1518,
    1495, 1471, 1447, 1422, 1396, 1369, 1341, 1312, 1282, 1251, 1219, 1186, 1151, 1114, 1077, 1037, 995,  952,  906,
    857,  805,  750,  690,  625,  553,  471,  376,  255};

// Probability that the next bit is 0, in 1/65536.
struct Probability {
  std::uint16_t zero = 0x8000;

  void update(int bit) {
    if (bit)
      zero = static_cast<std::uint16_t>(zero - kAdaptation[zero >> 8]);
    else
      zero = static_cast<std::uint16_t>(zero + kAdaptation[255 - (zero >> 8)]);
  }
};

// Doublings that bring a range of 1 to 0x4000 above 0x4000.
inline int doublings(std::uint32_t range) { return __builtin_clz(((range - 1) << 1) | 1) - 16; }

class BinaryEncoder {
 public:
  static constexpr bool kEncoder = true;
  explicit BinaryEncoder(std::vector<std::uint8_t>& out) : out_(out) {}

  int code(int bit, Probability& p) {
    const std::uint32_t zero_part = (range_ * p.zero) >> 16;
    p.update(bit);
    narrow(bit, zero_part);
    return bit;
  }
  int bypass(int bit) {
    narrow(bit, range_ >> 1);
    return bit;
  }
  bool failed() const { return false; }

  // Writes the low end of the range, padded with ones to whole bytes. (The reference looks for the longest run of ones
  // at its end that stays below the width of the range; so do we, to write the same bytes.)
  void finish() {
    while (pending_ >= 8) emit();
    int ones = 0;
    while (ones < 16 && (low_ | ((std::uint64_t{2} << ones) - 1)) < range_) ++ones;
    low_ |= (std::uint64_t{1} << ones) - 1;
    for (; pending_ % 8 != 0; ++pending_) low_ = low_ << 1 | 1;
    carry();
    for (int shift = 8 + pending_; shift >= 0; shift -= 8) out_.push_back(static_cast<std::uint8_t>(low_ >> shift));
  }

 private:
  void narrow(int bit, std::uint32_t zero_part) {
    if (bit) {
      low_ += zero_part;
      range_ -= zero_part;
    } else {
      range_ = zero_part;
    }
    if (range_ > 0x4000) return;
    const int shift = doublings(range_);
    range_ <<= shift;
    low_ <<= shift;
    pending_ += shift;
    while (pending_ >= 8 + 8) emit();
  }
  void carry() {
    if (low_ >> (16 + pending_) == 0) return;
    low_ &= (std::uint64_t{1} << (16 + pending_)) - 1;
    for (std::size_t i = out_.size(); i-- > 0 && ++out_[i] == 0;) {
    }
  }
  void emit() {
    carry();
    const int shift = 8 + pending_;
    out_.push_back(static_cast<std::uint8_t>(low_ >> shift));
    low_ &= (std::uint64_t{1} << shift) - 1;
    pending_ -= 8;
  }

  std::vector<std::uint8_t>& out_;
  std::uint64_t low_ = 0;      // 16 + pending_ bits, and a carry above them
  std::uint32_t range_ = 0xffff;
  int pending_ = 0;
};

// What decoders do with the range; where its bits come from is theirs to say: Decoder::refill() is called when `spare_` is
// negative, and makes it positive again.
template <class Decoder>
class RangeDecoder {
 public:
  static constexpr bool kEncoder = false;

  int code(int /*bit*/, Probability& p) {
    renormalise();
    const int bit = split((range_ * p.zero) >> 16);
    p.update(bit);
    return bit;
  }
  int bypass(int /*bit*/) {
    renormalise();
    return split(range_ >> 1);
  }
  void mark_corrupt() { corrupt_ = true; }

 protected:
  static constexpr int kSlack = 4;  // bytes that may be made up after the end
  static constexpr int kMostMadeUp = 1 << 24;

  void renormalise() {
    if (range_ > 0x4000) return;
    const int shift = doublings(range_);
    range_ <<= shift;
    spare_ -= shift;
    if (spare_ < 0) static_cast<Decoder*>(this)->refill();
  }

  std::uint64_t value_ = 0;    // distance from the low end of the range, with spare_ bits that are not yet in use
  std::uint32_t range_ = 0xffff;
  int spare_ = 0;
  int past_end_ = 0;           // bytes that were made up
  bool corrupt_ = false;

 private:
  int split(std::uint32_t zero_part) {
    const std::uint64_t threshold = static_cast<std::uint64_t>(zero_part) << spare_;
    if (value_ >= threshold) {
      value_ -= threshold;
      range_ -= zero_part;
      return 1;
    }
    range_ = zero_part;
    return 0;
  }
};

// The decoder of plain streams takes four bytes at a time.
class BinaryDecoder : public RangeDecoder<BinaryDecoder> {
 public:
  BinaryDecoder(const std::uint8_t* data, std::size_t size) : at_(data), end_(data + size) {
    for (int i = 0; i < 6; ++i) value_ = value_ << 8 | next();
    spare_ = 32;
  }

  // True once the bits in use lie well past the end of the data: whatever was decoded is made up.
  bool failed() const { return corrupt_ || past_end_ * 8 > spare_ + 8 * kSlack; }

 private:
  friend RangeDecoder<BinaryDecoder>;
  std::uint64_t next() {
    if (at_ < end_) return *at_++;
    if (past_end_ < kMostMadeUp) ++past_end_;
    return 0xff;
  }
  void refill() {
    for (int i = 0; i < 4; ++i) value_ = value_ << 8 | next();
    spare_ += 32;
  }

  const std::uint8_t* at_;
  const std::uint8_t* end_;
};

}  // namespace ggslam::GGSLAM_ISA::codec
