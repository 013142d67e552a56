// SPDX-License-Identifier: Apache-2.0
#include "volumes/scan_faces.hpp"

#include <algorithm>
#include <cmath>

#include "common/context.hpp"
#include "common/guard.hpp"

namespace ggslam::volumes {
namespace {

constexpr float kPi = 3.14159265f;
constexpr int kMostEmptyColumns = 2;  // between two columns that are joined
constexpr float kBeside = 0.02f;      // of the range: what is nearer to a face's plane through the sensor is not drawn
constexpr float kEdge = 1e-3f;        // pixels: so much beyond its edges a triangle is drawn, that none is left out between

}  // namespace

ScanFaces::ScanFaces(const ScanFaceSettings& settings, const float* points, std::size_t n) : settings_(settings) {
  sort_points(points, n);
  const int columns = settings.columns;
  for (int left = 0; left < columns; ++left) {
    if (first_[left] == first_[left + 1]) continue;
    int step = 1;
    while (step <= kMostEmptyColumns && first_[(left + step) % columns] == first_[(left + step) % columns + 1]) ++step;
    join_columns(left, (left + step) % columns);
  }
}

// Points by azimuth, and in each column of azimuths by elevation; those without a position, or out of range, are left out.
void ScanFaces::sort_points(const float* points, std::size_t n) {
  const int columns = settings_.columns;
  std::vector<Point> found;
  std::vector<std::uint32_t> column, next(columns + 1, 0);
  found.reserve(n), column.reserve(n);
  for (std::size_t i = 0; i < n; ++i) {
    const Vec3f p = Vec3f::from(points + 3 * i);
    const float flat = std::sqrt(p[0] * p[0] + p[1] * p[1]), range = std::sqrt(dot(p, p));
    if (!(range >= settings_.nearest && range <= settings_.farthest)) continue;
    const float turn = (std::atan2(p[1], p[0]) / kPi + 1) * 0.5f * columns;
    column.push_back(static_cast<std::uint32_t>(std::min(std::max(static_cast<int>(turn), 0), columns - 1)));
    found.push_back({p, range, p[2] / std::max(flat, 1e-6f * range)});
    ++next[column.back() + 1];
  }
  for (int c = 0; c < columns; ++c) next[c + 1] += next[c];
  first_ = next;
  points_.resize(found.size());
  for (std::size_t i = 0; i < found.size(); ++i) points_[next[column[i]]++] = found[i];
  for (int c = 0; c < columns; ++c)
    std::sort(points_.begin() + first_[c], points_.begin() + first_[c + 1],
              [](const Point& a, const Point& b) { return a.slope < b.slope; });
}

// Joins the points of two columns by a strip of triangles, from the lowest to the highest.
void ScanFaces::join_columns(std::uint32_t left, std::uint32_t right) {
  std::uint32_t a = first_[left], b = first_[right];
  const std::uint32_t last_a = first_[left + 1] - 1, last_b = first_[right + 1] - 1;
  if (first_[right] == first_[right + 1]) return;
  while (a < last_a || b < last_b) {
    const bool take_a = b == last_b || (a < last_a && points_[a + 1].slope < points_[b + 1].slope);
    add_triangle(a, b, take_a ? a + 1 : b + 1);
    ++(take_a ? a : b);
  }
}

// Keeps a triangle that is likely a piece of surface: it is small, and no ray only grazes it.
void ScanFaces::add_triangle(std::uint32_t a, std::uint32_t b, std::uint32_t c) {
  const Vec3f &p = points_[a].at, &q = points_[b].at, &r = points_[c].at;
  const Vec3f pq = q - p, pr = r - p, qr = r - q;
  const float most = settings_.max_edge * settings_.max_edge;
  if (dot(pq, pq) > most || dot(pr, pr) > most || dot(qr, qr) > most) return;
  const Vec3f normal = cross(pq, pr), middle = p + q + r;
  const float facing = dot(normal, middle);
  if (facing * facing < settings_.min_incidence * settings_.min_incidence * dot(normal, normal) * dot(middle, middle))
    return;
  triangles_.insert(triangles_.end(), {a, b, c});
}

void ScanFaces::draw(Context& context, const float* faces, int count, float* depth) const {
  const std::size_t pixels = static_cast<std::size_t>(settings_.size) * settings_.size;
  context.pool.parallel_for(count, 1, [&](std::size_t begin, std::size_t end, int) {
    for (std::size_t f = begin; f < end; ++f) draw_face(Mat3f::from(faces + 9 * f), depth + f * pixels);
  });
}

// `axes`: right, down and forward of the face, row by row.
void ScanFaces::draw_face(const Mat3f& axes, float* depth) const {
  const int size = settings_.size;
  const float half = 0.5f * size, middle = 0.5f * (size - 1);
  std::fill_n(depth, static_cast<std::size_t>(size) * size, 0.0f);
  std::vector<Vec3f> seen(points_.size());  // column, row, depth; depth 0: beside the face
  for (std::size_t i = 0; i < points_.size(); ++i) {
    const Vec3f p = axes * points_[i].at;
    const bool before = p[2] > kBeside * points_[i].range;
    seen[i] = before ? Vec3f{{half * p[0] / p[2] + middle, half * p[1] / p[2] + middle, p[2]}} : Vec3f{{0, 0, 0}};
  }
  for (std::size_t t = 0; t < triangles_.size(); t += 3) {
    const Vec3f &a = seen[triangles_[t]], &b = seen[triangles_[t + 1]], &c = seen[triangles_[t + 2]];
    if (a[2] <= 0 || b[2] <= 0 || c[2] <= 0) continue;
    const Vec3f low = min(a, min(b, c)), high = max(a, max(b, c));
    if (high[0] < -kEdge || high[1] < -kEdge || low[0] > size - 1 + kEdge || low[1] > size - 1 + kEdge) continue;
    const float area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
    if (!(std::fabs(area) > 1e-6f)) continue;
    const float sign = area > 0 ? 1.0f : -1.0f, over = 1 / area;
    // Inverse depth is linear in the image: 1 / z = at_a + u along_u + v along_v.
    const float ia = 1 / a[2], ib = 1 / b[2] - ia, ic = 1 / c[2] - ia;
    const float along_u = over * (ib * (c[1] - a[1]) - ic * (b[1] - a[1]));
    const float along_v = over * (ic * (b[0] - a[0]) - ib * (c[0] - a[0]));
    const Vec3f* const corners[4] = {&a, &b, &c, &a};
    const int u0 = std::max(0, static_cast<int>(std::ceil(low[0] - kEdge)));
    const int u1 = std::min(size - 1, static_cast<int>(std::floor(high[0] + kEdge)));
    const int v0 = std::max(0, static_cast<int>(std::ceil(low[1] - kEdge)));
    const int v1 = std::min(size - 1, static_cast<int>(std::floor(high[1] + kEdge)));
    for (int v = v0; v <= v1; ++v)
      for (int u = u0; u <= u1; ++u) {
        bool inside = true;
        for (int k = 0; k < 3; ++k) {
          const Vec3f &p = *corners[k], &q = *corners[k + 1];
          const float along = std::max(std::fabs(q[0] - p[0]), std::fabs(q[1] - p[1]));
          inside &= sign * ((q[0] - p[0]) * (v - p[1]) - (q[1] - p[1]) * (u - p[0])) >= -kEdge * along;
        }
        const float inverse = ia + (u - a[0]) * along_u + (v - a[1]) * along_v;
        if (!inside || !(inverse > 0)) continue;
        float& z = depth[static_cast<std::size_t>(v) * size + u];
        if (z == 0 || inverse * z > 1) z = 1 / inverse;
      }
  }
}

}  // namespace ggslam::volumes

GGSLAM_EXPORT std::int64_t ggslam_scan_faces(void* context, const ggslam::volumes::ScanFaceSettings* settings_,
                                             const float* points, std::uint64_t n, const float* faces,
                                             std::int32_t count, float* depth) try {
  using namespace ggslam;
  using namespace ggslam::volumes;
  const ScanFaceSettings& s = object_of<ScanFaceSettings>(settings_);
  check_range("columns", s.columns, 4, 1 << 16), check_range("size", s.size, 8, 4096);
  check_range("nearest", s.nearest, 1e-6f, 1e9f), check_range("farthest", s.farthest, s.nearest, 1e9f);
  check_range("edge", s.max_edge, 1e-6f, 1e9f), check_range("incidence", s.min_incidence, 0.0f, 1.0f);
  check_array("points", points, static_cast<std::int64_t>(elements(static_cast<std::int64_t>(n), 3)));
  check_range("faces", count, 1, 64);
  for (int f = 0; f < count; ++f) check_rotation(faces + 9 * f);
  check_array("depth", depth, 1);
  const ScanFaces scan(s, points, n);
  scan.draw(object_of<Context>(context), faces, count, depth);
  return static_cast<std::int64_t>(scan.triangles());
} GGSLAM_CATCH_ALL
