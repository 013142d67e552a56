// SPDX-License-Identifier: Apache-2.0
// Entry points of what is asked of regions: which plane pixels lie on, what lies between regions, where they are.
#include <array>
#include <cstddef>
#include <numeric>
#include <unordered_map>
#include <vector>

#include "objects/images.hpp"

namespace ggslam {
namespace {

constexpr int kNone = -1;

// Counts by pairs of numbers, found again in ascending order.
template <std::size_t Kinds>
class PairCounts {
 public:
  using Counts = std::array<std::int64_t, Kinds>;

  // Row of a pair; links of one pair come one after the other.
  std::size_t row_of(std::int32_t first, std::int32_t second) {
    const std::uint64_t code = static_cast<std::uint64_t>(first) << 32 | static_cast<std::uint32_t>(second);
    if (size() && code == last_code_) return last_row_;
    const auto [place, is_new] = row_of_code_.try_emplace(code, size());
    if (is_new) codes_.push_back(code), counts.push_back({});
    last_code_ = code, last_row_ = place->second;
    return last_row_;
  }

  std::size_t size() const { return codes_.size(); }

  // Rows in ascending order of their pairs.
  std::vector<std::size_t> order() const {
    std::vector<std::size_t> rows(size());
    std::iota(rows.begin(), rows.end(), std::size_t{0});
    std::sort(rows.begin(), rows.end(), [&](std::size_t a, std::size_t b) { return codes_[a] < codes_[b]; });
    return rows;
  }

  void write(std::size_t row, std::int64_t* pair, std::int64_t* to) const {
    pair[0] = static_cast<std::int64_t>(codes_[row] >> 32), pair[1] = static_cast<std::int64_t>(codes_[row] & 0xFFFFFFFF);
    std::copy(counts[row].begin(), counts[row].end(), to);
  }

  std::vector<Counts> counts;

 private:
  std::unordered_map<std::uint64_t, std::size_t> row_of_code_;
  std::vector<std::uint64_t> codes_;
  std::size_t last_row_ = 0;
  std::uint64_t last_code_ = 0;
};

// What one link between two regions tells.
struct Link {
  bool closed, judged, concave, bent;
  float contrast;
};

const float* normal_at(const BordersJob& job, std::int64_t pixel) {
  const std::int32_t plane = job.plane_of[pixel];
  return plane ? row3(job.plane_normals, plane - 1) : row3(job.surface.normals, pixel);
}

Link examine(const BordersJob& job, const LinkAxis& axis, std::int64_t a, int place) {
  const SegmentedSurface& s = job.surface;
  const std::int64_t b = a + axis.along;
  std::int64_t p = axis.shifted(a, place, -job.reach), q = axis.shifted(b, place + 1, job.reach);
  const bool reaches = job.regions[p] == job.regions[a] && job.regions[q] == job.regions[b];
  if (!reaches) p = a, q = b;
  const float *from = row3(s.points, a), *to = row3(s.points, b), *n = normal_at(job, p), *m = normal_at(job, q);
  const float step[3] = {to[0] - from[0], to[1] - from[1], to[2] - from[2]}, gap = gap_at(s, a);
  // Closed unless neither surface, continued, meets the other.
  const bool closed = std::min(std::fabs(dot3(n, step)), std::fabs(dot3(m, step))) < gap &&
                      std::fabs(step[2]) < steepest_step(gap, from[2]);
  const bool judged = reaches && closed;
  const bool bent = judged && static_cast<double>(dot3(n, m)) < job.least_cosine;
  const bool concave = bent && dot_differences(n, m, row3(s.points, p), row3(s.points, q)) < 0;
  const float *c = row3(job.colors, p), *d = row3(job.colors, q);
  return {closed, judged, concave, bent, std::sqrt(dot_differences(c, d, c, d))};
}

std::int64_t find_borders(const BordersJob& job) {
  PairCounts<5> found;
  std::vector<std::vector<float>> contrasts;
  over_axes(job.surface.height, job.surface.width, [&](const LinkAxis& axis) {
    for (int y = 0; y < axis.rows; ++y)
      for (int x = 0; x < axis.columns; ++x) {
        const std::int64_t pixel = axis.pixel(y, x);
        const std::int32_t first = job.regions[pixel], second = job.regions[pixel + axis.along];
        if (first == second || first == 0 || second == 0) continue;
        const Link link = examine(job, axis, pixel, axis.place(y, x));
        const std::size_t row = found.row_of(std::min(first, second), std::max(first, second));
        if (row == contrasts.size()) contrasts.emplace_back();
        contrasts[row].push_back(link.contrast);
        auto& counts = found.counts[row];
        counts[0] += 1, counts[1] += link.closed, counts[2] += link.judged;
        counts[3] += link.concave, counts[4] += link.bent;
      }
  });
  const std::int64_t count = static_cast<std::int64_t>(found.size());
  if (count > job.room) return count;
  std::int64_t k = 0;
  for (const std::size_t row : found.order()) {
    found.write(row, job.pairs + 2 * k, job.counts + 5 * k);
    const auto middle = contrasts[row].begin() + static_cast<std::ptrdiff_t>(contrasts[row].size() / 2);
    std::nth_element(contrasts[row].begin(), middle, contrasts[row].end());
    job.contrast[k++] = *middle;
  }
  return count;
}

std::int64_t find_contacts(const ContactsJob& job) {
  PairCounts<4> found;
  const auto add = [&](std::int32_t piece, std::int32_t other, float own, float beyond) {
    const float step = own - beyond, limit = job.near_m + job.near_relative * own;
    const float before = job.before_m + job.before_relative * own;
    auto& counts = found.counts[found.row_of(piece, job.owner[other])];
    counts[0] += 1, counts[1] += std::fabs(step) < limit;
    counts[2] += step > -job.behind_relative * own, counts[3] += step >= before;
  };
  over_axes(job.height, job.width, [&](const LinkAxis& axis) {
    for (int y = 0; y < axis.rows; ++y)
      for (int x = 0; x < axis.columns; ++x) {
        const std::int64_t pixel = axis.pixel(y, x), next = pixel + axis.along;
        const std::int32_t first = job.pieces[pixel], second = job.pieces[next];
        if (first == second) continue;
        add(first, second, job.depth[pixel], job.depth[next]);
        add(second, first, job.depth[next], job.depth[pixel]);
      }
  });
  const std::int64_t count = static_cast<std::int64_t>(found.size());
  if (count > job.room) return count;
  std::int64_t k = 0;
  for (const std::size_t row : found.order()) found.write(row, job.pairs + 2 * k, job.counts + 4 * k), ++k;
  return count;
}

void claim(const PlaneClaimJob& job) {
  const SegmentedSurface& s = job.surface;
  std::vector<float> units(3 * static_cast<std::size_t>(job.count));  // towards the camera
  for (int k = 0; k < job.count; ++k) {
    const float *w = row3(job.planes, k), norm = std::sqrt(dot3(w, w));
    for (int c = 0; c < 3; ++c) units[3 * k + c] = -w[c] / norm;
  }
  for (int y = 0; y < s.height; ++y)
    for (int x = 0; x < s.width; ++x) {
      const std::int64_t i = static_cast<std::int64_t>(y) * s.width + x;
      job.label[i] = 0;
      if (!s.valid[i]) continue;
      const float inverse = s.inverse[i], *normal = row3(s.normals, i);
      float nearest = job.tolerance + job.tolerance_m * (inverse * inverse);
      for (int k = 0; k < job.count; ++k) {
        const float* w = row3(job.planes, k);
        const float away = std::fabs(inverse - (w[0] * job.rays_x[x] + (w[1] * job.rays_y[y] + w[2])));
        if (!(away < nearest)) continue;
        if (static_cast<double>(dot3(normal, units.data() + 3 * k)) > job.least_cosine) nearest = away, job.label[i] = k + 1;
      }
    }
}

// Sums by region, divided by the numbers of pixels: means of what `value_of` says of each, an array of Width.
template <std::size_t Width, class F>
void mean_by_region(const BodiesJob& job, double* means, F value_of) {
  std::fill(means, means + Width * static_cast<std::size_t>(job.regions_end), 0.0);
  for (std::int64_t i = 0; i < job.pixels; ++i) {
    const std::int32_t region = job.regions[i];
    if (region == 0) continue;
    const std::array<double, Width> value = value_of(i, region);
    for (std::size_t k = 0; k < Width; ++k) means[Width * region + k] += value[k];
  }
  for (std::int32_t region = 0; region < job.regions_end; ++region)
    for (std::size_t k = 0; k < Width; ++k)
      means[Width * region + k] /= static_cast<double>(std::max<std::int64_t>(job.counts[region], 1));
}

void find_bodies(const BodiesJob& job) {
  const std::size_t end = static_cast<std::size_t>(job.regions_end);
  std::fill(job.counts, job.counts + end, 0);
  for (std::int64_t i = 0; i < job.pixels; ++i) job.counts[job.regions[i]] += job.regions[i] != 0;
  std::vector<double> middles(6 * end), moments(3 * end);
  mean_by_region<6>(job, middles.data(), [&](std::int64_t i, std::int32_t) {
    const float *p = row3(job.points, i), *n = row3(job.normals, i);
    return std::array<double, 6>{p[0], p[1], p[2], n[0], n[1], n[2]};
  });
  mean_by_region<3>(job, moments.data(), [&](std::int64_t i, std::int32_t region) {
    const float *p = row3(job.points, i), *n = row3(job.normals, i);
    const double* middle = middles.data() + 6 * static_cast<std::size_t>(region);
    double square = 0, spread = 0, bend = 0;
    for (int c = 0; c < 3; ++c) {
      const double away = p[c] - middle[c], turned = n[c] - middle[3 + c];
      square += away * away, spread += turned * turned, bend += away * turned;
    }
    return std::array<double, 3>{square, spread, bend};
  });
  for (std::size_t k = 0; k < end; ++k) {
    std::copy_n(middles.data() + 6 * k, 3, job.centres + 3 * k);
    job.squares[k] = moments[3 * k], job.spreads[k] = moments[3 * k + 1], job.bends[k] = moments[3 * k + 2];
  }
}

void measure_on_planes(const RegionsOnPlanesJob& job) {
  // For each region the first that is asked about it, and for each of these the next.
  std::vector<std::int64_t> first(static_cast<std::size_t>(job.regions_end), kNone), next(static_cast<std::size_t>(job.count));
  std::vector<float> norms(static_cast<std::size_t>(job.count));
  for (std::int64_t k = 0; k < job.count; ++k) {
    RegionOnPlane& asked = job.asked[k];
    check_range("region", asked.region, 0, job.regions_end - 1);
    asked.points = asked.near_by = 0;
    next[k] = first[asked.region], first[asked.region] = k;
    norms[k] = std::sqrt(dot3(asked.plane, asked.plane));
  }
  for (std::int64_t i = 0; i < job.pixels; ++i)
    for (std::int64_t k = first[job.regions[i]]; k != kNone; k = next[k]) {
      const float away = std::fabs(dot3(row3(job.points, i), job.asked[k].plane) - 1) / norms[k];
      job.asked[k].points += 1, job.asked[k].near_by += away < job.limit_m;
    }
}

}  // namespace
}  // namespace ggslam

GGSLAM_EXPORT int64_t ggslam_region_borders(const ggslam::BordersJob* job_) try {
  using namespace ggslam;
  const BordersJob& job = object_of<BordersJob>(job_);
  check_surface(job.surface);
  check_range("reach", job.reach, 0, kMostPixelsAlong);
  const std::int64_t pixels = static_cast<std::int64_t>(job.surface.height) * job.surface.width;
  check_array("colors", job.colors, 1), check_array("plane normals", job.plane_normals, job.planes);
  check_array("pairs", job.pairs, job.room), check_array("counts", job.counts, job.room);
  check_array("contrast", job.contrast, job.room);
  check_range("planes", job.planes, 0, 1 << 20);
  check_numbers("planes", job.plane_of, pixels, job.planes + 1);
  check_numbers("regions", job.regions, pixels, job.regions_end);
  return find_borders(job);
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int64_t ggslam_piece_contacts(const ggslam::ContactsJob* job_) try {
  using namespace ggslam;
  const ContactsJob& job = object_of<ContactsJob>(job_);
  check_size(job.height, job.width);
  check_array("depth", job.depth, 1), check_array("owner", job.owner, job.pieces_end);
  check_array("pairs", job.pairs, job.room), check_array("counts", job.counts, job.room);
  check_numbers("pieces", job.pieces, static_cast<std::int64_t>(job.height) * job.width, job.pieces_end);
  return find_contacts(job);
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_claim_planes(const ggslam::PlaneClaimJob* job_) try {
  using namespace ggslam;
  const PlaneClaimJob& job = object_of<PlaneClaimJob>(job_);
  check_surface(job.surface);
  check_range("planes", job.count, 0, 1 << 20);
  check_array("planes", job.planes, job.count), check_array("label", job.label, 1);
  check_array("rays", job.rays_x, 1), check_array("rays", job.rays_y, 1);
  claim(job);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_regions_on_planes(const ggslam::RegionsOnPlanesJob* job_) try {
  using namespace ggslam;
  const RegionsOnPlanesJob& job = object_of<RegionsOnPlanesJob>(job_);
  check_numbers("regions", job.regions, job.pixels, job.regions_end);
  check_array("points", job.points, job.pixels), check_array("asked", job.asked, job.count);
  measure_on_planes(job);
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_region_bodies(const ggslam::BodiesJob* job_) try {
  using namespace ggslam;
  const BodiesJob& job = object_of<BodiesJob>(job_);
  check_numbers("regions", job.regions, job.pixels, job.regions_end);
  check_array("points", job.points, job.pixels), check_array("normals", job.normals, job.pixels);
  elements(job.regions_end, 6);
  void* const results[] = {job.counts, job.centres, job.squares, job.spreads, job.bends};
  for (const void* result : results) check_array("results", result, job.regions_end);
  find_bodies(job);
  return 0;
} GGSLAM_CATCH_ALL
