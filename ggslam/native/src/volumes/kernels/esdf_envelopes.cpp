// SPDX-License-Identifier: Apache-2.0
// Nearest sites of all voxels of a box, axis by axis: along x by scanning, along y and z as lower envelopes of
// parabolas (A. Meijster et al., "A general algorithm for computing distance transforms in linear time", 2000;
// P. Felzenszwalb and D. Huttenlocher, "Distance Transforms of Sampled Functions", 2012). Of sites at the same distance
// the one with the lower z, then y, then x wins: the result depends on the sites alone, not on the box.
#include <vector>

#include "volumes/esdf_types.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

using namespace ggslam::volumes;

struct Parabola {
  int start, position, height, site;  // lowest from `start` on
};

int square(int a) { return a * a; }

int divide_down(int a, int b) {
  const int q = a / b;
  return q - (a - q * b < 0);
}

// Puts the parabola at `position` onto the envelope; returns its new size.
int push(Parabola* envelope, int size, int first, int last, int position, int height, int site) {
  int start = first;
  while (size > 0) {
    const Parabola& top = envelope[size - 1];
    // The last place where the earlier one is not higher.
    const int even = divide_down(
        (position - top.position) * (position + top.position) + height - top.height, 2 * (position - top.position));
    if (even >= top.start) {
      start = even + 1;
      break;
    }
    --size;
  }
  if (start >= last) return size;
  envelope[size] = {start, position, height, site};
  return size + 1;
}

template <bool kAlongZ>
void envelopes(const EnvelopeLines& lines) {
  thread_local std::vector<Parabola> stack;
  if (static_cast<int>(stack.size()) < lines.count + 1) stack.resize(lines.count + 1);
  Parabola* envelope = stack.data();
  for (int c = 0; c < lines.columns; ++c) {
    int size = 0;
    for (int i = 0; i < lines.count; ++i) {
      const int site = lines.in[lines.positions[i] * lines.in_stride + c];
      if (site < 0) continue;
      const SiteCell cell = lines.cells[site];
      const int height = square(lines.x + c - cell.x) + (kAlongZ ? square(lines.y - cell.y) : 0);
      if (height > lines.limit) continue;
      size = push(envelope, size, lines.first, lines.last, lines.positions[i], height, site);
    }
    int32_t* out = lines.out + c;
    if (size == 0) {
      for (int p = lines.first; p < lines.last; ++p, out += lines.out_stride) *out = -1;
      continue;
    }
    envelope[size].start = lines.last;
    int p = lines.first;
    for (int e = 0; e < size; ++e)
      for (; p < envelope[e + 1].start; ++p, out += lines.out_stride) *out = envelope[e].site;
  }
}

}  // namespace

// Nearest sites of the voxels x ... x + count - 1 of a row; xs [sites] are the sites' places, ascending, `first` the
// number of the first.
void esdf_row(const SiteCell* cells, int sites, int first, int x, int count, int32_t* out) {
  int s = 0;
  for (int i = 0; i < count; ++i) {
    while (s + 1 < sites && 2 * (x + i) > cells[s].x + cells[s + 1].x) ++s;
    out[i] = first + s;
  }
}

void esdf_envelopes(const EnvelopeLines& lines, bool along_z) {
  if (along_z) envelopes<true>(lines);
  else envelopes<false>(lines);
}

}  // namespace ggslam::GGSLAM_ISA
