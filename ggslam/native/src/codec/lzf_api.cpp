// SPDX-License-Identifier: Apache-2.0
// LZF, the byte-oriented Lempel-Ziv code of compressed PCD files (format of M. Lehmann's liblzf): a byte below 32 is the
// number of literal bytes, less one, that follow; another one begins a match: upper 3 bits the length less two (7: a
// byte to add follows), lower 5 bits and one more byte how far back it lies, less one.
#include <cstdint>
#include <cstring>
#include <vector>

#include "common/context.hpp"
#include "common/guard.hpp"
#include "abi/core/codec.hpp"

namespace {

constexpr int kHashBits = 14;
constexpr int64_t kMaxLiterals = 32;
constexpr int64_t kMaxMatch = 264;
constexpr int64_t kMaxDistance = 8192;

enum Failure : int64_t { kEndsInMatch = -1, kBeforeData = -2, kWrongSize = -3, kNoRoom = -4 };

uint32_t hash_of(const uint8_t* bytes) {
  const uint32_t value = bytes[0] << 16 | bytes[1] << 8 | bytes[2];
  return (value * 2654435761u) >> (32 - kHashBits);
}

uint8_t* put_literals(uint8_t* out, const uint8_t* from, const uint8_t* to) {
  while (from < to) {
    const int64_t count = to - from < kMaxLiterals ? to - from : kMaxLiterals;
    *out++ = static_cast<uint8_t>(count - 1);
    std::memcpy(out, from, count);
    out += count;
    from += count;
  }
  return out;
}

uint8_t* put_match(uint8_t* out, int64_t length, int64_t distance) {
  const int64_t coded = length - 2, back = distance - 1;
  *out++ = static_cast<uint8_t>((coded < 7 ? coded : 7) << 5 | back >> 8);
  if (coded >= 7) *out++ = static_cast<uint8_t>(coded - 7);
  *out++ = static_cast<uint8_t>(back & 255);
  return out;
}

}  // namespace

GGSLAM_EXPORT int64_t ggslam_lzf_compress(const uint8_t* data, int64_t size, uint8_t* out, int64_t capacity) try {
  ggslam::check_array("data", data, size);
  ggslam::elements(size);
  if (capacity < size + size / kMaxLiterals + 1) return kNoRoom;
  ggslam::check_array("out", out, capacity);
  std::vector<int64_t> last(size_t{1} << kHashBits, -kMaxDistance - 1);
  uint8_t* const begin = out;
  int64_t at = 0, literals = 0;  // literals: where the bytes not yet written begin
  while (at + 2 < size) {
    int64_t& place = last[hash_of(data + at)];
    const int64_t found = place;
    place = at;
    if (at - found > kMaxDistance || std::memcmp(data + found, data + at, 3) != 0) {
      ++at;
      continue;
    }
    int64_t length = 3;
    while (length < kMaxMatch && at + length < size && data[found + length] == data[at + length]) ++length;
    out = put_literals(out, data + literals, data + at);
    out = put_match(out, length, at - found);
    at += length;
    literals = at;
  }
  return put_literals(out, data + literals, data + size) - begin;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int64_t ggslam_lzf_decompress(const uint8_t* data, int64_t packed, uint8_t* out, int64_t size) try {
  ggslam::check_array("data", data, packed), ggslam::check_array("out", out, size);
  int64_t at = 0, done = 0;
  while (at < packed) {
    const int64_t control = data[at++];
    if (control < kMaxLiterals) {
      const int64_t count = control + 1;
      if (count > packed - at || count > size - done) return kWrongSize;
      std::memcpy(out + done, data + at, count);
      at += count;
      done += count;
      continue;
    }
    int64_t length = (control >> 5) + 2;
    if (length == 9 && at < packed) length += data[at++];
    if (at >= packed) return kEndsInMatch;
    const int64_t from = done - ((control & 31) << 8) - data[at++] - 1;
    if (from < 0) return kBeforeData;
    if (length > size - done) return kWrongSize;
    for (int64_t i = 0; i < length; ++i) out[done + i] = out[from + i];  // the source may reach into the copy
    done += length;
  }
  return done == size ? 0 : kWrongSize;
} GGSLAM_CATCH_ALL
