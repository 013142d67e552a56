// SPDX-License-Identifier: Apache-2.0
// The Gaussians at the chosen pixels: discs on the measured surface, and small spheres where pixels without depth are
// filled.
#pragma once
#include "mapping/insertion.cuh"

namespace ggslam::cuda::insertion {

constexpr int kBuildThreads = 128;
constexpr float kHarmonic0 = 0.28209479177387814f;  // SH_C0 of ggslam/scene/gaussian_map.py

struct Vector {
  float x, y, z;
};

__device__ inline Vector operator+(const Vector& a, const Vector& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
__device__ inline Vector operator-(const Vector& a, const Vector& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
__device__ inline Vector operator*(float s, const Vector& a) { return {s * a.x, s * a.y, s * a.z}; }
__device__ inline float dot(const Vector& a, const Vector& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
__device__ inline float length(const Vector& a) { return sqrtf(dot(a, a)); }
__device__ inline Vector unit(const Vector& a) { return (1.0f / fmaxf(length(a), 1e-12f)) * a; }
__device__ inline Vector cross(const Vector& a, const Vector& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// The point in the camera frame that a pixel sees at depth z.
__device__ inline Vector position_at(const InsertionJob& job, int x, int y, float z) {
  return {(static_cast<float>(x) - job.cx) / job.fx * z, (static_cast<float>(y) - job.cy) / job.fy * z, z};
}

// The same of the measured depth, at the nearest pixel of the image if (x, y) is outside.
__device__ inline Vector measured_position(const InsertionJob& job, int x, int y) {
  const int column = min(max(x, 0), job.width - 1), row = min(max(y, 0), job.height - 1);
  return position_at(job, column, row, depth_at(job, column, row));
}

__device__ inline float inverse_depth(const InsertionJob& job, int x, int y) {
  return 1.0f / fmaxf(depth_at(job, x, y), 1e-3f);
}

// Whether depth is unknown at a pixel or jumps there: a plane is linear in inverse depth however steeply it is seen.
__device__ inline bool is_broken(const InsertionJob& job, int x, int y) {
  if (job.depth[static_cast<std::int64_t>(y) * job.width + x] == 0) return true;
  const float inverse = inverse_depth(job, x, y);
  float bend = 0.0f;
  if (x > 0 && x < job.width - 1)
    bend = fabsf(inverse_depth(job, x + 1, y) + inverse_depth(job, x - 1, y) - 2.0f * inverse);
  if (y > 0 && y < job.height - 1)
    bend = fmaxf(bend, fabsf(inverse_depth(job, x, y + 1) + inverse_depth(job, x, y - 1) - 2.0f * inverse));
  return bend > 0.03f * inverse;
}

// Whether the pixel is inside the image's border and depth known and without a jump in the 5 x 5 pixels around it.
__device__ inline bool has_surface(const InsertionJob& job, int x, int y) {
  if (x <= 0 || x >= job.width - 1 || y <= 0 || y >= job.height - 1) return false;
  for (int row = max(y - 2, 0); row <= min(y + 2, job.height - 1); ++row)
    for (int column = max(x - 2, 0); column <= min(x + 2, job.width - 1); ++column)
      if (is_broken(job, column, row)) return false;
  return true;
}

// Unit normal towards the camera from central differences of positions averaged over 3 x 3 pixels. Of the two averages
// that are subtracted one column (or row) is the same and left out.
__device__ inline Vector surface_normal(const InsertionJob& job, int x, int y) {
  Vector du = {0.0f, 0.0f, 0.0f}, dv = du;
  for (int across = -1; across <= 1; ++across)
    for (int along = 1; along <= 2; ++along) {
      du = du + (measured_position(job, x + along, y + across) - measured_position(job, x - along, y + across));
      dv = dv + (measured_position(job, x + across, y + along) - measured_position(job, x + across, y - along));
    }
  return unit(cross(1.0f / 9.0f * dv, 1.0f / 9.0f * du));
}

// Slope direction, across it, normal; and how much longer than its footprint the disc is in these directions.
struct Disc {
  Vector axes[3];
  float stretch[3];
};

__device__ inline Disc disc_at(const InsertionJob& job, int x, int y, const Vector& position) {
  const Vector ray = -1.0f / length(position) * position;
  const bool known = has_surface(job, x, y);
  const Vector measured = known ? surface_normal(job, x, y) : Vector{0.0f, 0.0f, 0.0f};
  const bool has_normal = dot(measured, measured) > 0.5f;
  const Vector n = has_normal ? measured : ray;
  const Vector slope = cross(n, ray);
  const float steepness = length(slope);
  const Vector helper = fabsf(n.x) < 0.9f ? Vector{1.0f, 0.0f, 0.0f} : Vector{0.0f, 1.0f, 0.0f};
  const Vector across = steepness > 1e-4f ? 1.0f / steepness * slope : unit(cross(n, helper));
  const float cosine = fminf(fmaxf(dot(n, ray), 1e-3f), 1.0f);
  Disc disc = {{cross(across, n), across, n}, {1.0f, 1.0f, 1.0f}};
  if (has_normal) {
    disc.stretch[0] = fminf(1.0f / cosine, job.max_slope);
    disc.stretch[2] = job.flatness;
  }
  return disc;
}

__device__ inline Vector to_world(const InsertionJob& job, const Vector& v) {
  const float* R = job.rotation;
  return {R[0] * v.x + R[1] * v.y + R[2] * v.z, R[3] * v.x + R[4] * v.y + R[5] * v.z,
          R[6] * v.x + R[7] * v.y + R[8] * v.z};
}

// Quaternion wxyz of the rotation matrix with columns a, b, c: of four equivalent formulas the one with the largest
// divisor (Shepperd 1978).
__device__ inline void quaternion_of(const Vector& a, const Vector& b, const Vector& c, float q[4]) {
  const float w = 1.0f + a.x + b.y + c.z, x = 1.0f + a.x - b.y - c.z;
  const float y = 1.0f - a.x + b.y - c.z, z = 1.0f - a.x - b.y + c.z;
  const float wx = b.z - c.y, wy = c.x - a.z, wz = a.y - b.x;
  const float xy = a.y + b.x, xz = c.x + a.z, yz = b.z + c.y;
  if (w >= x && w >= y && w >= z) {
    q[0] = w, q[1] = wx, q[2] = wy, q[3] = wz;
  } else if (x >= y && x >= z) {
    q[0] = wx, q[1] = x, q[2] = xy, q[3] = xz;
  } else if (y >= z) {
    q[0] = wy, q[1] = xy, q[2] = y, q[3] = yz;
  } else {
    q[0] = wz, q[1] = xz, q[2] = yz, q[3] = z;
  }
  const float scale = 1.0f / sqrtf(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (int i = 0; i < 4; ++i) q[i] *= scale;
}

__device__ inline void write_mean(const InsertionJob& job, std::int64_t i, const Vector& position) {
  const Vector world = to_world(job, position);
  job.means[3 * i] = world.x + job.translation[0];
  job.means[3 * i + 1] = world.y + job.translation[1];
  job.means[3 * i + 2] = world.z + job.translation[2];
}

// A channel's value, 0 to 255.
__device__ inline void write_color(const InsertionJob& job, std::int64_t i, int channel, float value) {
  const float color = value / 255.0f;
  job.colors[job.color_numbers * i + channel] = job.as_harmonics != 0 ? (color - 0.5f) / kHarmonic0 : color;
}

__device__ inline void build_disc(const InsertionJob& job, std::int64_t i, int x, int y, float stride) {
  const Vector position = measured_position(job, x, y);
  const Disc disc = disc_at(job, x, y, position);
  write_mean(job, i, position);
  quaternion_of(to_world(job, disc.axes[0]), to_world(job, disc.axes[1]), to_world(job, disc.axes[2]),
                job.quaternions + 4 * i);
  const float footprint = job.scale_pixels * stride * position.z * (2.0f / (job.fx + job.fy));
  const std::uint8_t* color = job.color + 3 * (static_cast<std::int64_t>(y) * job.width + x);
  for (int k = 0; k < 3; ++k) {
    job.log_scales[3 * i + k] = logf(footprint * disc.stretch[k]);
    write_color(job, i, k, static_cast<float>(color[k]));
  }
}

// The colour is the mean over a square of the grid's stride, rounded to a whole number (halves up).
__device__ inline void build_filling(const InsertionJob& job, std::int64_t i, int x, int y, float z) {
  const int stride = job.fill_stride;
  write_mean(job, i, position_at(job, x, y, z));
  const float sigma = 2.0f * job.scale_pixels * static_cast<float>(stride) * z * (2.0f / (job.fx + job.fy));
  unsigned sums[3] = {0, 0, 0};
  for (int row = y - stride / 2; row < y - stride / 2 + stride; ++row)
    for (int column = x - stride / 2; column < x - stride / 2 + stride; ++column) {
      const std::int64_t pixel = static_cast<std::int64_t>(reflected(row, job.height)) * job.width;
      const std::uint8_t* color = job.color + 3 * (pixel + reflected(column, job.width));
      for (int k = 0; k < 3; ++k) sums[k] += color[k];
    }
  const unsigned count = static_cast<unsigned>(stride) * static_cast<unsigned>(stride);
  for (int k = 0; k < 3; ++k) {
    job.log_scales[3 * i + k] = logf(sigma);
    write_color(job, i, k, static_cast<float>((2 * sums[k] + count) / (2 * count)));
  }
  for (int k = 0; k < 4; ++k) job.quaternions[4 * i + k] = k == 0 ? 1.0f : 0.0f;
}

// A thread for each new Gaussian.
__global__ void __launch_bounds__(kBuildThreads) build_kernel(InsertionJob job, Candidates candidates, Workspace w) {
  const std::int64_t i = static_cast<std::int64_t>(blockIdx.x) * kBuildThreads + threadIdx.x;
  if (i >= job.count) return;
  const bool coarse = (w.order[i] & kCoarse) != 0;
  const auto number = static_cast<int>(w.order[i] & ~kCoarse), fill = number - static_cast<int>(candidates.pixels);
  int x, y;
  if (fill < 0) {
    x = number % job.width, y = number / job.width;
    build_disc(job, i, x, y, coarse ? 2.0f : 1.0f);
  } else {
    const int wide = candidates.fill_wide;
    x = fill % wide * job.fill_stride + job.fill_stride / 2;
    y = fill / wide * job.fill_stride + job.fill_stride / 2;
    build_filling(job, i, x, y, w.fill_depth[fill]);
  }
  job.pixels[i] = y * job.width + x;
}

}  // namespace ggslam::cuda::insertion
