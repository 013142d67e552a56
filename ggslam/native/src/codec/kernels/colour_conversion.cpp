// SPDX-License-Identifier: Apache-2.0
// Colours to attribute components and back (ITU-R BT.709, full range, 8 bits), for every colour as the reference
// software has it. In integers: every machine rounds alike, halves away from zero. Luma is in double, where 769 of all
// colours lie a hair below a half: the codec's files are compiled without fused multiply-adds, so every machine sees it.
#include <algorithm>
#include <cstddef>
#include <cstdint>

namespace ggslam::GGSLAM_ISA {
namespace {

constexpr std::int32_t kOne = 100000;

std::uint8_t to_byte(std::int32_t value) { return static_cast<std::uint8_t>(std::min(std::max(value, 0), 255)); }

// value / kOne, halves away from zero.
std::int32_t scaled_down(std::int32_t value) { return (value + (value < 0 ? -kOne / 2 : kOne / 2)) / kOne; }

}  // namespace

// out [count, 3] Y, Cb, Cr of rgb[order[i]]. Chroma is raised by 128 before it is rounded; factors in millionths.
void colours_to_ycbcr(const std::uint8_t* rgb, const std::uint32_t* order, std::uint32_t count, std::int32_t* out) {
  constexpr std::int32_t kMillion = 1000000, kRaised = 128 * kMillion + kMillion / 2;
  for (std::uint32_t i = 0; i < count; ++i, out += 3) {
    const std::uint8_t* c = rgb + 3 * static_cast<std::size_t>(order[i]);
    const std::int32_t r = c[0], g = c[1], b = c[2];
    out[0] = static_cast<std::int32_t>(0.2126 * r + 0.7152 * g + 0.0722 * b + 0.5);
    out[1] = std::min((-114572 * r - 385428 * g + 500000 * b + kRaised) / kMillion, 255);
    out[2] = std::min((500000 * r - 454153 * g - 45847 * b + kRaised) / kMillion, 255);
  }
}

// rgb [count, 3] of components [count, 3], each in [0, 255].
void colours_from_ycbcr(const std::int32_t* components, std::uint32_t count, std::uint8_t* rgb) {
  for (std::uint32_t i = 0; i < count; ++i, components += 3, rgb += 3) {
    const std::int32_t y = kOne * components[0], u = components[1] - 128, v = components[2] - 128;
    rgb[0] = to_byte(scaled_down(y + 157480 * v));
    rgb[1] = to_byte(scaled_down(y - 18733 * u - 46813 * v));
    rgb[2] = to_byte(scaled_down(y + 185563 * u));
  }
}

}  // namespace ggslam::GGSLAM_ISA
