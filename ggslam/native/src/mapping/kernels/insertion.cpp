// SPDX-License-Identifier: Apache-2.0
// Which pixels of a keyframe get a Gaussian, and what it looks like: a disc on the surface that was measured.
#include "mapping/insertion.hpp"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>

#include "common/vector.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

constexpr float kNearest = 0.05f;  // metres; nearer measurements do not become Gaussians
constexpr float kStep = 0.3f;      // share of the depth by which a Sobel filter sees it change at an edge
constexpr float kEdge = 1e3f;      // texture that stands for one
constexpr float kBend = 0.03f;     // share of the inverse depth by which it bends at a jump

// The rows about one of an image, which is its own mirror image beyond the border.
template <class T>
struct Around {
  const T *above, *here, *below;

  Around(const T* image, const InsertionJob& job, int row) {
    const auto at = [&](int y) { return image + static_cast<std::size_t>(y) * job.width; };
    above = at(row > 0 ? row - 1 : std::min(1, job.height - 1));
    here = at(row);
    below = at(row < job.height - 1 ? row + 1 : std::max(0, job.height - 2));
  }

  // Sum of the absolute derivatives by column and row, as a Sobel filter sees them.
  auto sobel(int left, int x, int right) const {
    const auto across = (above[right] - above[left]) + 2 * (here[right] - here[left]) + (below[right] - below[left]);
    const auto down = (below[left] - above[left]) + 2 * (below[x] - above[x]) + (below[right] - above[right]);
    return std::abs(across) + std::abs(down);
  }
};

inline float inverse_depth(float z) { return 1 / (z > 1e-3f ? z : 1e-3f); }

inline float second_difference(float before, float here, float after) { return std::fabs(before + after - 2 * here); }

// out[x] |= f(left, x, right) for all x, mirrored at the borders; the compiler vectorises what is between them.
template <class F>
void over_row(int width, uint8_t* __restrict out, F f) {
  const int last = width - 1;
  out[0] |= f(std::min(1, last), 0, std::min(1, last));
  for (int x = 1; x < last; ++x) out[x] |= f(x - 1, x, x + 1);
  if (last > 0) out[last] |= f(last - 1, last, last - 1);
}

// out[x] |= bit & (in[x - reach] | ... | in[x + reach]); `in` has that much room on each side.
void spread(const uint8_t* __restrict in, uint8_t* __restrict out, int width, int reach, uint8_t bit) {
  for (int x = 0; x < width; ++x) {
    uint8_t any = 0;
    for (int d = -reach; d <= reach; ++d) any |= in[x + d];
    out[x] |= any & bit;
  }
}

void join(uint8_t* __restrict to, const uint8_t* __restrict row, int width) {
  for (int x = 0; x < width; ++x) to[x] |= row[x];
}

// Normal towards the camera at a pixel, from central differences of means over 3x3 points; zero at the image's border.
Vec3f normal_at(const InsertionJob& job, int row, int column) {
  const int width = job.width, height = job.height;
  if (row < 1 || row > height - 2 || column < 1 || column > width - 2) return Vec3f::all(0);
  Vec3f across = Vec3f::all(0), down = Vec3f::all(0);
  const auto add = [&](Vec3f& to, int y, int x, float sign) {
    y = std::clamp(y, 0, height - 1), x = std::clamp(x, 0, width - 1);
    const float z = sign * job.depth[static_cast<std::size_t>(y) * width + x];
    to = to + Vec3f{{(x - job.cx) / job.fx * z, (y - job.cy) / job.fy * z, z}};
  };
  for (int side = -1; side <= 1; ++side)
    for (int d = 1; d <= 2; ++d) {  // the means overlap: what is in both cancels out
      add(across, row + side, column + d, 1), add(across, row + side, column - d, -1);
      add(down, row + d, column + side, 1), add(down, row - d, column + side, -1);
    }
  const Vec3f normal = cross(down, across);  // rows run down and columns right: this order faces the camera
  return (1 / std::max(length(normal), 1e-30f)) * normal;
}

// Quaternion wxyz of a rotation by Shepperd's method: of four formulas the one with the largest divisor.
void quaternion_of(const Mat3f& r, float* q) {
  const float xx = r(0, 0), yy = r(1, 1), zz = r(2, 2);
  const float squares[4] = {1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz};
  const float a = r(2, 1) - r(1, 2), b = r(0, 2) - r(2, 0), c = r(1, 0) - r(0, 1);
  const float d = r(0, 1) + r(1, 0), e = r(0, 2) + r(2, 0), f = r(1, 2) + r(2, 1);
  const float rows[4][4] = {{squares[0], a, b, c}, {a, squares[1], d, e}, {b, d, squares[2], f}, {c, e, f, squares[3]}};
  const float* best = rows[std::max_element(squares, squares + 4) - squares];
  const float norm = std::sqrt(best[0] * best[0] + best[1] * best[1] + best[2] * best[2] + best[3] * best[3]);
  for (int k = 0; k < 4; ++k) q[k] = best[k] / norm;
}

// The direction across the slope of a surface: square to its normal and to the ray back to the camera.
Vec3f across_slope(const Vec3f& normal, const Vec3f& ray) {
  const Vec3f across = cross(normal, ray);
  const float size = length(across);
  if (size > 1e-4f) return (1 / size) * across;
  const Vec3f helper = std::fabs(normal[0]) < 0.9f ? Vec3f{{1, 0, 0}} : Vec3f{{0, 1, 0}};
  return normalize(cross(normal, helper));
}

}  // namespace

void insertion_grey(const InsertionJob& job, uint8_t* __restrict grey, int begin, int end) {
  const std::size_t width = job.width;
  const uint8_t* __restrict color = job.color;
  for (std::size_t i = begin * width; i < end * width; ++i)
    grey[i] = (4899 * color[3 * i] + 9617 * color[3 * i + 1] + 1868 * color[3 * i + 2] + 8192) >> 14;
}

void insertion_bits(const InsertionJob& job, const uint8_t* grey, uint8_t* bits, int row) {
  uint8_t* out = bits + static_cast<std::size_t>(row) * job.width;
  std::memset(out, 0, job.width);
  const Around<float> depth(job.depth, job, row);
  const bool inner = row > 0 && row < job.height - 1;
  // A plane is linear in inverse depth however steeply it is seen, so a jump shows in the second difference.
  over_row(job.width, out, [&](int left, int x, int right) -> uint8_t {
    const float inverse = inverse_depth(depth.here[x]);
    const float across = second_difference(inverse_depth(depth.here[left]), inverse, inverse_depth(depth.here[right]));
    const float down = second_difference(inverse_depth(depth.above[x]), inverse, inverse_depth(depth.below[x]));
    const float bend = std::max(left < x && x < right ? across : 0.f, inner ? down : 0.f);  // none at borders
    return (bend > kBend * inverse) | !(depth.here[x] > 0) ? kBroken : 0;
  });
  if (!job.adaptive_stride) return;
  const Around<uint8_t> colors(grey, job, row);
  const float threshold = job.texture_threshold;
  over_row(job.width, out, [&](int left, int x, int right) -> uint8_t {
    const float texture = static_cast<float>(colors.sobel(left, x, right));
    const float change = depth.sobel(left, x, right) > kStep * depth.here[x] ? kEdge : texture;
    return change < threshold ? 0 : kChanges;
  });
}

int insertion_choose(const InsertionJob& job, const uint8_t* bits, int row, uint8_t* scratch, int64_t* pixels) {
  const int width = job.width;
  const std::size_t first = static_cast<std::size_t>(row) * width;
  uint8_t *near = scratch + 2, *wide = scratch + width + 4 + 2;  // with two zeros at each end
  std::memset(scratch, 0, 2 * (width + 4));
  for (int y = std::max(0, row - 2); y <= std::min(job.height - 1, row + 2); ++y) {
    const uint8_t* of_row = bits + static_cast<std::size_t>(y) * width;
    join(wide, of_row, width);
    if (std::abs(y - row) <= 1) join(near, of_row, width);
  }
  uint8_t* marks = job.marks + first;
  std::memset(marks, 0, width);
  spread(near, marks, width, 1, kChanges);
  spread(wide, marks, width, 2, kBroken);
  const float* depth = job.depth + first;
  int count = 0;
  for (int x = 0; x < width; ++x) {
    const bool dense = !job.adaptive_stride | ((marks[x] & kChanges) != 0), on_grid = dense | ((row & x & 1) != 0);
    const bool usable = (depth[x] > kNearest) & (depth[x] < job.max_depth);
    pixels[count] = static_cast<int64_t>(first) + x;
    count += on_grid & usable & (job.where == nullptr || job.where[first + x] != 0);
  }
  return count;
}

void insertion_shape(const InsertionJob& job, std::int64_t begin, std::int64_t end) {
  const Mat3f R = Mat3f::from(job.rotation);
  const Vec3f t = Vec3f::from(job.translation);
  for (std::int64_t i = begin; i < end; ++i) {
    const std::int64_t pixel = job.pixels[i];
    const int row = static_cast<int>(pixel / job.width), column = static_cast<int>(pixel % job.width);
    const float z = job.depth[pixel];
    const Vec3f point{{(column - job.cx) / job.fx * z, (row - job.cy) / job.fy * z, z}};
    const Vec3f ray = (-1 / length(point)) * point;  // back to the camera
    Vec3f n = job.marks[pixel] & kBroken ? Vec3f::all(0) : normal_at(job, row, column);
    const bool has_normal = dot(n, n) > 0.5f;
    if (!has_normal) n = ray;
    const Vec3f across = across_slope(n, ray), along = cross(across, n);
    const int stride = job.adaptive_stride && !(job.marks[pixel] & kChanges) ? 2 : 1;
    const float footprint = job.scale_pixels * stride * z * (2 / (job.fx + job.fy));
    const float stretch = std::min(1 / std::clamp(dot(n, ray), 1e-3f, 1.f), job.max_slope);
    const Mat3f axes = Mat3f{{along, across, n}}.transpose();
    (R * point + t).to(job.means + 3 * i);
    quaternion_of(R * axes, job.quaternions + 4 * i);
    float* logs = job.log_scales + 3 * i;
    logs[0] = std::log(footprint * (has_normal ? stretch : 1));
    logs[1] = std::log(footprint);
    logs[2] = std::log(footprint * (has_normal ? job.flatness : 1));
    for (int c = 0; c < 3; ++c) job.rgb[3 * i + c] = job.color[3 * pixel + c] / 255.f;
  }
}

}  // namespace ggslam::GGSLAM_ISA
