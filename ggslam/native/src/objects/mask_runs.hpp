// SPDX-License-Identifier: Apache-2.0
// Runs of equal ids along the rows of a mask. A mask has few of them, so that passes over runs cost little beside a look
// at each pixel.
#pragma once
#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <numeric>
#include <utility>
#include <vector>

namespace ggslam {

constexpr int kIds = 1 << 16;

// Columns [begin, end) of a row.
struct Run {
  std::int32_t begin, end;
  std::uint16_t id;
};

// All runs of a mask in raster order.
struct MaskRuns {
  std::vector<Run> runs;
  std::vector<std::size_t> row_begin;  // [H + 1], of each row the first run

  MaskRuns(const std::uint16_t* mask, int height, int width) {
    row_begin.reserve(static_cast<std::size_t>(height) + 1);
    for (int y = 0; y < height; ++y, mask += width) {
      row_begin.push_back(runs.size());
      for (int x = 0; x < width;) {
        const int end = end_of_run(mask, x, width);
        runs.push_back({x, end, mask[x]});
        x = end;
      }
    }
    row_begin.push_back(runs.size());
  }

  int rows() const { return static_cast<int>(row_begin.size()) - 1; }

  // Four pixels at a time.
  static int end_of_run(const std::uint16_t* row, int begin, int width) {
    const std::uint64_t wanted = std::uint64_t{0x0001000100010001} * row[begin];
    int x = begin + 1;
    for (std::uint64_t four; x + 4 <= width; x += 4) {
      std::memcpy(&four, row + x, sizeof four);
      if (four != wanted) break;
    }
    while (x < width && row[x] == row[begin]) ++x;
    return x;
  }
};

// f(k, m, begin, end) for the columns that run k of row `y` of `a` shares with run m of row `v` of `b`, of equal widths.
template <class F>
void over_shared_columns(const MaskRuns& a, int y, const MaskRuns& b, int v, F f) {
  std::size_t k = a.row_begin[y], m = b.row_begin[v];
  while (k < a.row_begin[y + 1]) {
    const Run &one = a.runs[k], &other = b.runs[m];
    f(k, m, std::max(one.begin, other.begin), std::min(one.end, other.end));
    const bool next = one.end <= other.end;
    if (other.end <= one.end) ++m;
    if (next) ++k;
  }
}

// Disjoint sets of runs: the 4-connected pieces of equal id.
class RunPieces {
 public:
  explicit RunPieces(const MaskRuns& mask) : parent_(mask.runs.size()) {
    std::iota(parent_.begin(), parent_.end(), std::size_t{0});
    for (int y = 1; y < mask.rows(); ++y)
      over_shared_columns(mask, y - 1, mask, y, [&](std::size_t k, std::size_t m, int, int) {
        if (mask.runs[k].id == mask.runs[m].id) join(k, m);
      });
  }

  // The first run of a run's piece.
  std::size_t of(std::size_t run) {
    while (parent_[run] != run) run = parent_[run] = parent_[parent_[run]];
    return run;
  }

 private:
  void join(std::size_t a, std::size_t b) {
    a = of(a), b = of(b);
    parent_[std::max(a, b)] = std::min(a, b);
  }

  std::vector<std::size_t> parent_;
};

}  // namespace ggslam
