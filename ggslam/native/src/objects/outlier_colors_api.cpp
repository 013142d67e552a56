// SPDX-License-Identifier: Apache-2.0
// Entry point of what colours say of a plane: which of them occur in few places of it.
#include <array>
#include <cstddef>
#include <vector>

#include "objects/images.hpp"

namespace ggslam {
namespace {

constexpr int kMostBins = 1 << 22;
enum Kind : uint8_t { kOrdinary = 0, kInAnotherLight = 1, kOfAnotherHue = 2 };

// The colours of a plane in bins, and where in the image each bin occurs.
class PlaneColors {
 public:
  explicit PlaneColors(const OutlierColorsJob& job) : job_(job) {
    place_pixels();
    number_bins();
    count();
  }

  std::size_t bins() const { return bins_; }
  std::size_t bin_of(std::size_t k) const { return bin_[k]; }
  const std::vector<std::int64_t>& pixels() const { return pixels_; }

  // Whether a bin, with those that touch it, occurs in many cells: a colour is not at another place for being on the
  // other side of a bin's edge.
  bool is_usual(std::size_t bin) const {
    std::vector<std::int64_t> there(cells_, 0);
    const auto [l, a, b] = places_[bin];
    for (int i = std::max(0, l - 1); i <= std::min(sides_[0] - 1, l + 1); ++i)
      for (int j = std::max(0, a - 1); j <= std::min(sides_[1] - 1, a + 1); ++j)
        for (int k = std::max(0, b - 1); k <= std::min(sides_[2] - 1, b + 1); ++k) {
          const std::int32_t other = number_[code(i, j, k)];
          for (std::size_t c = 0; other >= 0 && c < cells_; ++c) there[c] += table_[other * cells_ + c];
        }
    std::int64_t counted = 0, occurs = 0;
    for (std::size_t c = 0; c < cells_; ++c) {
      if (cell_pixels_[c] == 0 || static_cast<double>(cell_pixels_[c]) < job_.least_cell) continue;
      counted += 1;
      occurs += static_cast<double>(there[c]) / static_cast<double>(cell_pixels_[c]) >= job_.occurs;
    }
    return static_cast<double>(occurs) / static_cast<double>(counted) >= job_.usual;
  }

  // Whether one bin's mean colour may be another's, in shadow or in the sun.
  bool is_shade_of(std::size_t bin, std::size_t other) const {
    const auto &own = means_[bin], &usual = means_[other];
    const double shade = own[0] / std::max(usual[0], 1.0);
    // Squares, not std::hypot: the C library rounded that otherwise before glibc 2.35.
    const double u = own[1] - usual[1], v = own[2] - usual[2];
    return u * u + v * v < job_.same_hue * job_.same_hue && shade > job_.darkest && shade < job_.brightest;
  }

 private:
  // The pixels of the plane, their cells, and the bins of their colours, from 0 on along each channel.
  void place_pixels() {
    const std::size_t cells_across = static_cast<std::size_t>((job_.width - 1) / job_.cell + 1);
    cells_ = cells_across * static_cast<std::size_t>((job_.height - 1) / job_.cell + 1);
    std::array<int, 3> low{1 << 30, 1 << 30, 1 << 30}, high{-(1 << 30), -(1 << 30), -(1 << 30)};
    for (int y = 0; y < job_.height; ++y)
      for (int x = 0; x < job_.width; ++x) {
        const std::int64_t i = static_cast<std::int64_t>(y) * job_.width + x;
        if (!job_.inside[i]) continue;
        pixels_.push_back(i);
        cell_.push_back(static_cast<std::size_t>(y / job_.cell) * cells_across + static_cast<std::size_t>(x / job_.cell));
        const float light = static_cast<float>(job_.light[0] * y + job_.light[1] * x + job_.light[2]);
        const float* lab = row3(job_.lab, i);
        const float color[3] = {lab[0] - light, lab[1], lab[2]};
        std::array<int, 3> place;
        for (int c = 0; c < 3; ++c) {
          place[c] = static_cast<int>(std::clamp(std::floor(color[c] / job_.bins[c]), -1e6f, 1e6f));
          low[c] = std::min(low[c], place[c]), high[c] = std::max(high[c], place[c]);
        }
        of_pixel_.push_back(place);
      }
    for (auto& place : of_pixel_)
      for (int c = 0; c < 3; ++c) place[c] -= low[c];
    std::int64_t volume = 1;
    for (int c = 0; c < 3; ++c) {
      sides_[c] = pixels_.empty() ? 1 : high[c] - low[c] + 1;
      volume *= sides_[c];
      if (volume > kMostBins) refuse("bins of colours: expected at most %d, found more", kMostBins);
    }
    number_.assign(static_cast<std::size_t>(volume), -1);
  }

  std::size_t code(int i, int j, int k) const {
    return (static_cast<std::size_t>(i) * sides_[1] + static_cast<std::size_t>(j)) * sides_[2] + static_cast<std::size_t>(k);
  }

  void number_bins() {
    for (const auto& [i, j, k] : of_pixel_) {
      std::int32_t& number = number_[code(i, j, k)];
      if (number < 0) number = static_cast<std::int32_t>(bins_++), places_.push_back({i, j, k});
      bin_.push_back(static_cast<std::size_t>(number));
    }
  }

  void count() {
    table_.assign(bins_ * cells_, 0), cell_pixels_.assign(cells_, 0), means_.assign(bins_, {});
    std::vector<std::int64_t> counts(bins_, 0);
    for (std::size_t k = 0; k < pixels_.size(); ++k) {
      const float* lab = row3(job_.lab, pixels_[k]);
      for (int c = 0; c < 3; ++c) means_[bin_[k]][c] += lab[c];
      counts[bin_[k]] += 1, table_[bin_[k] * cells_ + cell_[k]] += 1, cell_pixels_[cell_[k]] += 1;
    }
    for (std::size_t bin = 0; bin < bins_; ++bin)
      for (double& mean : means_[bin]) mean /= static_cast<double>(counts[bin]);
  }

  const OutlierColorsJob& job_;
  std::vector<std::int64_t> pixels_;  // and of each:
  std::vector<std::size_t> cell_, bin_;
  std::vector<std::array<int, 3>> of_pixel_;
  std::array<int, 3> sides_{};
  std::vector<std::int32_t> number_;         // of the bin at a place, -1 = empty
  std::vector<std::array<int, 3>> places_;   // of each bin
  std::vector<std::array<double, 3>> means_;
  std::vector<std::int64_t> table_, cell_pixels_;  // [bins, cells], [cells]
  std::size_t bins_ = 0, cells_ = 0;
};

std::vector<Kind> kinds_of(const PlaneColors& colors) {
  std::vector<Kind> kinds(colors.bins(), kOrdinary);
  std::vector<std::size_t> usual, others;
  for (std::size_t bin = 0; bin < colors.bins(); ++bin) (colors.is_usual(bin) ? usual : others).push_back(bin);
  for (const std::size_t bin : others) {
    const bool shaded = std::any_of(usual.begin(), usual.end(), [&](std::size_t u) { return colors.is_shade_of(bin, u); });
    kinds[bin] = shaded ? kInAnotherLight : kOfAnotherHue;
  }
  return kinds;
}

}  // namespace
}  // namespace ggslam

GGSLAM_EXPORT int ggslam_outlier_colors(const ggslam::OutlierColorsJob* job_) try {
  using namespace ggslam;
  const OutlierColorsJob& job = object_of<OutlierColorsJob>(job_);
  check_size(job.height, job.width);
  check_range("cell", job.cell, 1, kMostPixelsAlong);
  const std::int64_t pixels = static_cast<std::int64_t>(job.height) * job.width;
  const void* const arrays[] = {job.lab, job.inside, job.kind};
  for (const void* array : arrays) check_array("images", array, 1);
  for (const float width : job.bins) check_range("bins", width, 1e-3f, 1e6f);
  check_numbers("pieces", job.pieces, pixels, job.pieces_end);
  const PlaneColors colors(job);
  const std::vector<Kind> kinds = kinds_of(colors);
  std::vector<std::int64_t> area(static_cast<std::size_t>(job.pieces_end), 0);
  for (const std::int64_t pixel : colors.pixels()) area[job.pieces[pixel]] += 1;
  std::fill(job.kind, job.kind + pixels, static_cast<uint8_t>(kOrdinary));
  const double base = job.base * static_cast<double>(colors.pixels().size());
  for (std::size_t k = 0; k < colors.pixels().size(); ++k) {
    const std::int64_t pixel = colors.pixels()[k];
    if (static_cast<double>(area[job.pieces[pixel]]) < base) job.kind[pixel] = kinds[colors.bin_of(k)];
  }
  return 0;
} GGSLAM_CATCH_ALL
