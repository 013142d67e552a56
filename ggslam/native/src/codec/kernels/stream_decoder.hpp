// SPDX-License-Identifier: Apache-2.0
// The arithmetic decoder for what plain streams do not have (ISO/IEC 23090-9, first edition): several codewords one
// after the other, and bins of equal probability in a stream of their own. It takes bytes one by one, as the place where
// a codeword ends matters.
#pragma once
#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

#include "codec/kernels/arithmetic_coder.hpp"

namespace ggslam::GGSLAM_ISA::codec {

// Chunks of 256 bytes, the last one shorter: a count n, n bytes of arithmetic code, then bits from the end of the chunk
// backwards. The last of these bytes says in its 3 lowest bits how many bits before them are padding.
class ChunkReader {
 public:
  ChunkReader(const std::uint8_t* data, std::size_t size) : data_(data, data + size) {}

  // Negative at the end.
  int byte() {
    if (code_left_ == 0) {
      while (next_code_ < end() && data_[next_code_] == 0) next_code_ += kChunk;
      if (next_code_ >= end() || next_code_ + data_[next_code_] >= end()) return -1;
      code_ = next_code_ + 1;
      code_left_ = data_[next_code_];
      next_code_ += kChunk;
    }
    --code_left_;
    return data_[code_++];
  }

  int bit() {
    if (bits_held_ == 0 && !fetch_bits()) return -1;
    --bits_held_;
    const int bit = held_ >> 7;
    held_ = static_cast<std::uint8_t>(held_ << 1);
    return bit;
  }

  // To the codeword that begins where this one ends. The bits of the last chunk were moved behind the first bytes of the
  // next codeword when the two were joined: they are taken out.
  void begin_codeword() {
    if (next_code_ < kChunk) return;
    const std::size_t chunk = next_code_ - kChunk, bits = chunk + 1 + data_[chunk];
    std::size_t start = bits;
    if (next_bits_ >= next_code_) {
      std::size_t last = bits_;  // one past the lowest byte of bits in use
      if (bits_held_ < 3 && last > bits) --last;
      const std::size_t chunk_end = std::min(chunk + kChunk, end());
      const std::size_t kept = last > bits ? last - bits : 0;
      std::memmove(data_.data() + chunk_end - kept, data_.data() + bits, kept);
      start = chunk_end - kept;
    }
    start_ = start;
    data_.erase(data_.begin(), data_.begin() + static_cast<std::ptrdiff_t>(std::min(start, data_.size())));
    next_code_ = next_bits_ = code_ = bits_ = 0;
    code_left_ = bits_left_ = bits_held_ = 0;
  }

 private:
  static constexpr std::size_t kChunk = 256;
  std::size_t end() const { return data_.size(); }

  bool fetch_bits() {
    bits_left_ -= 8;
    if (bits_left_ <= 0) {
      while (next_bits_ < end() && data_[next_bits_] == kChunk - 1) next_bits_ += kChunk;
      if (next_bits_ >= end()) return false;
      const std::size_t size = std::min(kChunk, end() - next_bits_), bytes = data_[next_bits_];
      if (bytes + 1 >= size) return false;
      const int padding = data_[next_bits_ + bytes + 1] & 7;
      bits_ = next_bits_ + size;
      bits_left_ = static_cast<int>(8 * (size - bytes)) - padding - 11;
      next_bits_ += kChunk;
      if (bits_left_ <= 0) return false;
    }
    if (bits_ == 0) return false;
    held_ = data_[--bits_];
    bits_held_ = std::min(bits_left_, 8);
    return true;
  }

  std::vector<std::uint8_t> data_;
  std::size_t next_code_ = 0, next_bits_ = 0;  // the chunks that are looked at next
  std::size_t code_ = 0, bits_ = 0;            // the next byte of code, one past the next byte of bits
  std::size_t start_ = 0;
  int code_left_ = 0, bits_left_ = 0, bits_held_ = 0;
  std::uint8_t held_ = 0;
};

class StreamDecoder : public RangeDecoder<StreamDecoder> {
 public:
  // `separate_bits`: bins of equal probability are a stream of their own.
  StreamDecoder(const std::uint8_t* data, std::size_t size, bool separate_bits)
      : at_(data), end_(data + size), chunks_(data, separate_bits ? size : 0), separate_bits_(separate_bits) {
    begin();
  }

  int bypass(int bit) {
    if (!separate_bits_) return RangeDecoder::bypass(bit);
    const int found = chunks_.bit();
    if (found < 0) corrupt_ = true;
    return found > 0;
  }

  // Ends a codeword and begins the next.
  void restart() {
    renormalise();
    if (separate_bits_) chunks_.begin_codeword();
    begin();
  }

  bool failed() const { return corrupt_ || past_end_ > kSlack; }

 private:
  friend RangeDecoder<StreamDecoder>;
  void begin() {
    range_ = 0xffff;
    spare_ = 0;
    value_ = next() << 8;
    value_ |= next();
  }
  std::uint32_t next() {
    const int byte = separate_bits_ ? chunks_.byte() : at_ < end_ ? *at_++ : -1;
    if (byte >= 0) return static_cast<std::uint32_t>(byte);
    if (past_end_ < kMostMadeUp) ++past_end_;
    return 0xff;
  }
  void refill() {
    for (; spare_ < 0; spare_ += 8) value_ = value_ << 8 | next();
  }

  const std::uint8_t* at_;
  const std::uint8_t* end_;
  ChunkReader chunks_;
  const bool separate_bits_;
};

inline void mark_corrupt(StreamDecoder& coder) { coder.mark_corrupt(); }

}  // namespace ggslam::GGSLAM_ISA::codec
