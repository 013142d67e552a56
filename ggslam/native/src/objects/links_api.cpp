// SPDX-License-Identifier: Apache-2.0
// Entry points of what hangs together: links between pixels on one surface, pieces, and regions that grow.
#include <limits>
#include <vector>

#include "objects/images.hpp"

namespace ggslam {
namespace {

constexpr float kSameDepth = 0.05f;  // share of the depth across which an edge is looked at

// How far, in metres, a pixel is from the straight line through its neighbours, inverse depth being straight on planes.
float miss_at(const SegmentedSurface& s, const LinkAxis& axis, std::int64_t pixel, int place) {
  if (place < 1 || place >= axis.length() - 1) return std::numeric_limits<float>::infinity();
  const float bend = s.inverse[pixel + axis.along] - 2 * s.inverse[pixel] + s.inverse[pixel - axis.along];
  return std::fabs(bend) * (s.depth[pixel] * s.depth[pixel]);
}

// Whether a pixel and the next one are on one surface: their depths are near, or either, continued, meets the other.
bool is_closed(const SegmentedSurface& s, const LinkAxis& axis, std::int64_t pixel, int place) {
  const std::int64_t next = pixel + axis.along;
  if (!s.valid[pixel] || !s.valid[next]) return false;
  const float step = std::fabs(s.depth[next] - s.depth[pixel]), gap = gap_at(s, pixel);
  if (step < gap) return true;
  if (!(step < steepest_step(gap, s.depth[pixel]))) return false;
  return std::min(miss_at(s, axis, pixel, place), miss_at(s, axis, next, place + 1)) < gap;
}

// Whether a concave edge lies between a pixel and the next one, looked at across a few pixels, where the edge itself does
// not blur normals.
bool is_concave(const SurfaceLinksJob& job, const LinkAxis& axis, std::int64_t pixel, int place) {
  const SegmentedSurface& s = job.surface;
  if (place < s.step || place + s.step + 1 >= axis.length()) return false;
  const std::int64_t start = pixel - static_cast<std::int64_t>(s.step) * axis.along;
  const std::int64_t end = pixel + static_cast<std::int64_t>(s.step + 1) * axis.along;
  if (!job.rest[start] || !job.rest[end]) return false;
  const float *n = row3(s.normals, start), *m = row3(s.normals, end);
  const float *a = row3(s.points, start), *b = row3(s.points, end);
  return static_cast<double>(dot3(n, m)) < job.least_cosine && dot_differences(n, m, a, b) < 0 &&
         std::fabs(b[2] - a[2]) < kSameDepth * s.depth[start];
}

void link_surfaces(const SurfaceLinksJob& job, const LinkAxis& axis, uint8_t* closed, uint8_t* smooth) {
  for (int y = 0; y < axis.rows; ++y)
    for (int x = 0; x < axis.columns; ++x) {
      const std::int64_t pixel = axis.pixel(y, x), link = axis.link(y, x);
      const int place = axis.place(y, x);
      closed[link] = is_closed(job.surface, axis, pixel, place);
      smooth[link] = closed[link] && job.rest[pixel] && job.rest[pixel + axis.along] &&
                     !is_concave(job, axis, pixel, place);
    }
}

// Disjoint sets of pixels, whose roots are their first pixels.
class PixelSets {
 public:
  explicit PixelSets(std::size_t count) : parent_(count) {}

  // A pixel in the set of an earlier one, or in its own.
  void start(std::int32_t i, std::int32_t of) { parent_[i] = of == i ? i : parent_[of]; }

  void join(std::int32_t a, std::int32_t b) {
    a = find(a), b = find(b);
    if (a < b) parent_[b] = a;
    else parent_[a] = b;
  }

  // To be asked for in ascending order, after which each parent is a root.
  std::int32_t settle(std::int32_t i) { return parent_[i] = parent_[parent_[i]]; }

 private:
  std::int32_t find(std::int32_t i) {
    while (parent_[i] != i) i = parent_[i] = parent_[parent_[i]];
    return i;
  }

  std::vector<std::int32_t> parent_;
};

// Numbers the pieces; `right` and `below` tell of the links of pixel (y, x) to its neighbours.
template <class Right, class Below>
std::int32_t number_pieces(const PiecesJob& job, Right right, Below below) {
  const int width = job.width;
  const std::int64_t pixels = static_cast<std::int64_t>(job.height) * width;
  PixelSets sets(static_cast<std::size_t>(pixels));
  for (int y = 0; y < job.height; ++y)
    for (int x = 0; x < width; ++x) {
      const std::int32_t i = y * width + x;
      const bool goes_on = x > 0 && right(y, x - 1), hangs = y > 0 && below(y - 1, x);
      sets.start(i, goes_on ? i - 1 : i);
      // Not again if the pixels to the left are joined already.
      if (hangs && !(goes_on && below(y - 1, x - 1) && right(y - 1, x - 1))) sets.join(i - width, i);
    }
  std::int32_t count = 0;
  for (std::int32_t i = 0; i < pixels; ++i) {
    const std::int32_t root = sets.settle(i);
    job.pieces[i] = root == i ? ++count : job.pieces[root];
  }
  return count;
}

// The region that a pixel is grown over by: of its left, right, upper and lower neighbour the first that has one.
std::int32_t region_beside(const GrowthJob& job, std::int64_t pixel) {
  const int width = job.width, y = static_cast<int>(pixel / width), x = static_cast<int>(pixel % width);
  const std::int64_t right = pixel - y;  // of a link in an image one pixel narrower
  if (x > 0 && job.links.right[right - 1] && job.regions[pixel - 1]) return job.regions[pixel - 1];
  if (x < width - 1 && job.links.right[right] && job.regions[pixel + 1]) return job.regions[pixel + 1];
  if (y > 0 && job.links.below[pixel - width] && job.regions[pixel - width]) return job.regions[pixel - width];
  if (y < job.height - 1 && job.links.below[pixel] && job.regions[pixel + width]) return job.regions[pixel + width];
  return 0;
}

}  // namespace
}  // namespace ggslam

GGSLAM_EXPORT int ggslam_surface_links(const ggslam::SurfaceLinksJob* job_) try {
  using namespace ggslam;
  const SurfaceLinksJob& job = object_of<SurfaceLinksJob>(job_);
  check_surface(job.surface);
  const int height = job.surface.height, width = job.surface.width;
  check_array("rest", job.rest, 1);
  check_links("closed", job.closed, height, width), check_links("smooth", job.smooth, height, width);
  over_axes(height, width, [&](const LinkAxis& axis) {
    if (axis.down) link_surfaces(job, axis, job.closed.below, job.smooth.below);
    else link_surfaces(job, axis, job.closed.right, job.smooth.right);
  });
  return 0;
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int32_t ggslam_connected_pieces(const ggslam::PiecesJob* job_) try {
  using namespace ggslam;
  const PiecesJob& job = object_of<PiecesJob>(job_);
  check_size(job.height, job.width);
  check_array("pieces", job.pieces, 1);
  const int width = job.width;
  if (job.ids == nullptr) {
    check_links("links", job.links, job.height, width);
    return number_pieces(
        job, [&](int y, int x) { return job.links.right[y * (width - 1) + x] != 0; },
        [&](int y, int x) { return job.links.below[y * width + x] != 0; });
  }
  const std::int32_t* ids = job.ids;
  return number_pieces(
      job, [&](int y, int x) { return ids[y * width + x] == ids[y * width + x + 1]; },
      [&](int y, int x) { return ids[y * width + x] == ids[(y + 1) * width + x]; });
} GGSLAM_CATCH_ALL

GGSLAM_EXPORT int ggslam_grow_regions(const ggslam::GrowthJob* job_) try {
  using namespace ggslam;
  const GrowthJob& job = object_of<GrowthJob>(job_);
  check_size(job.height, job.width);
  check_range("passes", job.passes, 0, kMostPixelsAlong);
  check_array("regions", job.regions, 1), check_array("valid", job.valid, 1);
  check_links("links", job.links, job.height, job.width);
  std::vector<std::int64_t> left, grown;
  std::vector<std::int32_t> found;
  const std::int64_t pixels = static_cast<std::int64_t>(job.height) * job.width;
  for (std::int64_t i = 0; i < pixels; ++i)
    if (job.regions[i] == 0 && job.valid[i]) left.push_back(i);
  for (int pass = 0; pass < job.passes && !left.empty(); ++pass) {
    grown.clear(), found.clear();
    std::size_t kept = 0;
    for (const std::int64_t pixel : left) {
      const std::int32_t region = region_beside(job, pixel);
      if (region) grown.push_back(pixel), found.push_back(region);
      else left[kept++] = pixel;
    }
    left.resize(kept);
    if (grown.empty()) break;
    for (std::size_t k = 0; k < grown.size(); ++k) job.regions[grown[k]] = found[k];
  }
  return 0;
} GGSLAM_CATCH_ALL
