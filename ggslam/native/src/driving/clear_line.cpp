// SPDX-License-Identifier: Apache-2.0
#include "driving/clear_line.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace ggslam::driving {
namespace {

constexpr double kRounding = 1e-9;  // of a line's length
constexpr double kExact = 1e-6;     // cells that a clearance is off by, rounded

// The pieces of a line between planes through cells' centres: within one, the interpolated clearance is a cubic.
class Pieces {
 public:
  Pieces(const Vec3<double>& from, const Vec3<double>& to, int dimensions) : from_(from), along_(to - from) {
    for (int a = 0; a < 3; ++a) {
      low_[a] = static_cast<int>(std::floor(from[a]));
      step_[a] = 0, next_[a] = std::numeric_limits<double>::infinity(), every_[a] = 0;
      if (a >= dimensions || along_[a] == 0) continue;
      step_[a] = along_[a] > 0 ? 1 : -1;
      if (along_[a] < 0 && static_cast<double>(low_[a]) == from[a]) --low_[a];
      every_[a] = 1 / std::fabs(along_[a]);
      next_[a] = (low_[a] + (step_[a] > 0) - from[a]) / along_[a];
    }
  }

  // The next piece: its lower cell, and from where to where along the line it reaches.
  bool advance() {
    if (end >= 1) return false;
    if (begun_) {
      for (int a = 0; a < 3; ++a)
        if (next_[a] <= end + kRounding) low_[a] += step_[a], next_[a] += every_[a];
    }
    begun_ = true;
    begin = end;
    end = std::min({next_[0], next_[1], next_[2], 1.0});
    return true;
  }

  const Vec3i& low() const { return low_; }
  Vec3<double> at(double t) const { return from_ + t * along_; }
  double length() const { return std::sqrt(dot(along_, along_)); }

  double begin = 0, end = 0;

 private:
  Vec3<double> from_, along_;
  Vec3i low_{{0, 0, 0}};
  int step_[3];
  double next_[3], every_[3];
  bool begun_ = false;
};

double between(const float* corners, int dimensions, const Vec3i& low, const Vec3<double>& place) {
  double sum = 0;
  for (int i = 0; i < 1 << dimensions; ++i) {
    double share = 1;
    for (int a = 0; a < dimensions; ++a) {
      const double t = std::clamp(place[a] - low[a], 0.0, 1.0);
      share *= i >> a & 1 ? t : 1 - t;
    }
    if (share > 0) sum += share * corners[i];
  }
  return sum;
}

// The least value of a piece: of the cubic through four of its points.
double least_of_piece(const Pieces& pieces, const float* corners, int dimensions) {
  double v[4];
  for (int i = 0; i < 4; ++i) {
    const double t = pieces.begin + (pieces.end - pieces.begin) * i / 3;
    v[i] = between(corners, dimensions, pieces.low(), pieces.at(t));
  }
  if (!(v[0] + v[1] + v[2] + v[3] == v[0] + v[1] + v[2] + v[3])) return std::numeric_limits<double>::quiet_NaN();
  const double a = 4.5 * (v[3] - 3 * v[2] + 3 * v[1] - v[0]), b = 9 * (v[0] - 2.5 * v[1] + 2 * v[2] - 0.5 * v[3]),
               c = -5.5 * v[0] + 9 * v[1] - 4.5 * v[2] + v[3];
  double least = std::min(v[0], v[3]);
  const auto look = [&](double s) {
    if (s > 0 && s < 1) least = std::min(least, ((a * s + b) * s + c) * s + v[0]);
  };
  if (std::fabs(a) < 1e-9) {
    if (std::fabs(b) > 1e-12) look(-c / (2 * b));
  } else if (const double root = b * b - 3 * a * c; root >= 0) {
    look((-b + std::sqrt(root)) / (3 * a)), look((-b - std::sqrt(root)) / (3 * a));
  }
  return least;
}

}  // namespace

bool is_clear(CellReader& reader, const Vec3<double>& from, const Vec3<double>& to, const WayCost& cost, double* sum) {
  const int dimensions = reader.grid().dimensions, count = 1 << dimensions;
  Pieces pieces(from, to, dimensions);
  float corners[8];
  double total = 0;
  while (pieces.advance()) {
    reader.corners(pieces.low(), corners);
    bool all = true;
    for (int i = 0; i < count; ++i) all &= corners[i] >= cost.radius;
    if (!all && !(least_of_piece(pieces, corners, dimensions) >= cost.radius - kExact)) return false;
    if (sum == nullptr) continue;
    const double middle = between(corners, dimensions, pieces.low(), pieces.at((pieces.begin + pieces.end) / 2));
    total += (pieces.end - pieces.begin) * cost.factor(static_cast<float>(middle));
  }
  if (sum != nullptr) *sum = total * pieces.length();
  return true;
}

float least_clearance(CellReader& reader, const Vec3<double>& from, const Vec3<double>& to) {
  Pieces pieces(from, to, reader.grid().dimensions);
  float corners[8];
  double least = std::numeric_limits<double>::infinity();
  while (pieces.advance()) {
    reader.corners(pieces.low(), corners);
    const double found = least_of_piece(pieces, corners, reader.grid().dimensions);
    if (!(found == found)) return std::numeric_limits<float>::quiet_NaN();
    least = std::min(least, found);
  }
  return static_cast<float>(least);
}

}  // namespace ggslam::driving
