// SPDX-License-Identifier: Apache-2.0
#include "driving/way_smoothing.hpp"

#include <algorithm>
#include <cmath>

#include "driving/clear_line.hpp"

namespace ggslam::driving {
namespace {

constexpr double kNoDearer = 1 + 1e-5;
constexpr double kStraight = 1e-6;   // squared sine between two steps that are one line
constexpr int kMostRefused = 12;     // bends in a row that cannot be left out, after which none behind them is tried
constexpr double kStill = 0.01;      // cells that no point moves any more by
constexpr double kTension = 0.5;     // part of the way to the neighbours' middle
constexpr int kHalvings = 3;         // of a move that is refused

double norm(const Vec3<double>& v) { return std::sqrt(dot(v, v)); }

WayCost cost_of(const WayGrid& grid, const SmoothingSettings& s) {
  const float scale = static_cast<float>(1 / grid.cell);
  return {s.radius * scale, s.margin * scale, s.weight};
}

// The points where a path bends, with its ends.
std::vector<Vec3<double>> bends(const std::vector<Vec3<double>>& path) {
  std::vector<Vec3<double>> out{path.front()};
  for (std::size_t i = 1; i + 1 < path.size(); ++i) {
    const Vec3<double> a = path[i] - out.back(), b = path[i + 1] - path[i], c = cross(a, b);
    if (dot(c, c) > kStraight * dot(a, a) * dot(b, b) || dot(a, b) < 0) out.push_back(path[i]);
  }
  out.push_back(path.back());
  return out;
}

std::vector<Vec3<double>> divide(const std::vector<Vec3<double>>& path, double spacing) {
  std::vector<Vec3<double>> out{path.front()};
  for (std::size_t i = 1; i < path.size(); ++i) {
    const Vec3<double> along = path[i] - path[i - 1];
    const int parts = std::max(1, static_cast<int>(std::ceil(norm(along) / spacing - 1e-9)));
    for (int k = 1; k < parts; ++k) out.push_back(path[i - 1] + (static_cast<double>(k) / parts) * along);
    out.push_back(path[i]);
  }
  return out;
}

// One path while it is smoothed.
class Band {
 public:
  Band(const WayGrid& grid, const SmoothingSettings& settings, std::vector<Vec3<double>> path)
      : points(std::move(path)), reader_(grid), cost_(cost_of(grid, settings)), push_(settings.push),
        most_(settings.most_length / grid.cell) {
    for (std::size_t i = 1; i < points.size(); ++i) length_ += norm(points[i] - points[i - 1]);
    most_ = std::max(most_, length_);
  }

  // Moves all points once; returns the largest move.
  double pass() {
    double largest = 0;
    for (std::size_t i = 1; i + 1 < points.size(); ++i) largest = std::max(largest, move(i));
    return largest;
  }

  std::vector<Vec3<double>> points;

 private:
  Vec3<double> wanted(std::size_t i) {
    const Vec3<double> along = points[i + 1] - points[i - 1];
    Vec3<double> step = kTension * (0.5 * (points[i - 1] + points[i + 1]) - points[i]);
    double slope[3];
    const float clearance = reader_.interpolate(points[i], slope);
    const double missing = cost_.radius + cost_.margin - clearance, steepness = dot(along, along);
    if (!(missing > 0)) return step;
    Vec3<double> away = Vec3<double>::from(slope);
    if (steepness > 0) away = away - (dot(away, along) / steepness) * along;
    const double size = norm(away);
    if (!(size > 1e-6)) return step;
    return step + (push_ * missing * std::min(1.0, size) / size) * away;
  }

  double move(std::size_t i) {
    Vec3<double> step = wanted(i);
    const Vec3<double>&before = points[i - 1], &after = points[i + 1];
    const double own = norm(points[i] - before) + norm(after - points[i]);
    for (int k = 0; k <= kHalvings; ++k, step = 0.5 * step) {
      const double size = norm(step);
      if (!(size > kStill / 4)) return 0;
      const Vec3<double> there = points[i] + step;
      const double longer = norm(there - before) + norm(after - there) - own;
      if (longer > 0 && length_ + longer > most_) continue;
      if (!is_clear(reader_, before, there, cost_, nullptr) || !is_clear(reader_, there, after, cost_, nullptr)) continue;
      points[i] = there, length_ += longer;
      return size;
    }
    return 0;
  }

  CellReader reader_;
  WayCost cost_;
  double push_, most_, length_ = 0;
};

}  // namespace

std::vector<Vec3<double>> pull_tight(const WayGrid& grid, const std::vector<Vec3<double>>& path,
                                     const SmoothingSettings& settings) {
  if (path.size() < 3) return path;
  const WayCost cost = cost_of(grid, settings);
  const std::vector<Vec3<double>> from = bends(path);
  CellReader reader(grid);
  std::vector<double> spent(from.size(), 0);
  for (std::size_t i = 1; i < from.size(); ++i) {
    double sum = 0;
    if (!is_clear(reader, from[i - 1], from[i], cost, &sum)) return path;  // no path of a search
    spent[i] = spent[i - 1] + sum;
  }
  std::vector<Vec3<double>> out{from.front()};
  for (std::size_t i = 0; i + 1 < from.size();) {
    std::size_t next = i + 1;
    int refused = 0;
    for (std::size_t k = i + 2; k < from.size() && refused < kMostRefused; ++k) {
      double sum = 0;
      if (is_clear(reader, from[i], from[k], cost, &sum) && sum <= (spent[k] - spent[i]) * kNoDearer) next = k, refused = 0;
      else ++refused;
    }
    out.push_back(from[next]);
    i = next;
  }
  return out;
}

std::vector<Vec3<double>> smooth(const WayGrid& grid, const std::vector<Vec3<double>>& path,
                                 const SmoothingSettings& settings) {
  Band band(grid, settings, divide(path, settings.spacing / grid.cell));
  for (int pass = 0; pass < settings.passes && band.pass() > kStill; ++pass) continue;
  return band.points;
}

}  // namespace ggslam::driving
