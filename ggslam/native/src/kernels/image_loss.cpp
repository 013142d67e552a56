// SPDX-License-Identifier: Apache-2.0
// L1 (or Charbonnier) + SSIM of colour, L1 of depth, and their gradients, in one sweep over bands of rows.
//
// SSIM (Wang et al. 2004, 11x11 Gaussian window G, sigma 1.5, zero padding) of x (rendered) and y (target):
//   S = A B / (C D),   A = 2 mx my + C1,        B = 2 (E[xy] - mx my) + C2,
//                      C = mx^2 + my^2 + C1,    D = E[x^2 + y^2] - mx^2 - my^2 + C2,
// where m and E are blurs by G: four blurs. The gradient of the sum of S with respect to x is three more:
//   G * (dS/dmx) + 2 x (G * dS/dE[x^2]) + y (G * dS/dE[xy]).
// A band runs down the image with the last 11 blurred rows of each kind in a ring, so that nothing but the result is
// written to memory: row y is blurred horizontally, which completes the statistics of row y - 5, whose derivatives
// are blurred horizontally, which completes the gradient of row y - 10.
#include "image_loss.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <utility>

#if defined(__SSE2__)
#include <immintrin.h>
#elif defined(__ARM_NEON)
#include <arm_neon.h>
#endif

namespace ggslam::GGSLAM_ISA {
namespace {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif
typedef float Floats __attribute__((vector_size(4 * kLanes)));

inline Floats load(const float* p) {
  Floats v;
  std::memcpy(&v, p, sizeof v);
  return v;
}
inline void store(float* p, Floats v) { std::memcpy(p, &v, sizeof v); }
inline Floats broadcast(float value) { return value - Floats{}; }
inline Floats absolute(Floats v) { return v < 0.f ? -v : v; }
inline Floats sign(Floats v) {
  const Floats zero{}, one = zero + 1.f;
  return v > 0.f ? one : (v < 0.f ? -one : zero);
}
inline Floats square_root(Floats v) {
#if defined(__AVX512F__)
  return _mm512_maskz_sqrt_ps(0xffff, v);  // the plain one makes GCC 12 warn of its own header
#elif defined(__AVX2__)
  return _mm256_sqrt_ps(v);
#elif defined(__SSE2__)
  return _mm_sqrt_ps(v);
#elif defined(__ARM_NEON) && defined(__aarch64__)
  return vsqrtq_f32(v);
#else
  for (int i = 0; i < kLanes; ++i) v[i] = std::sqrt(v[i]);
  return v;
#endif
}
inline double total(Floats v) {
  double sum = 0;
  for (int i = 0; i < kLanes; ++i) sum += v[i];
  return sum;
}

constexpr int kTaps = kImageLossTaps, kRadius = kTaps / 2, kPad = kImageLossPad;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
// exp(-k^2 / (2 1.5^2)) for k = 0..5, divided by the sum over -5..5.
constexpr float kWindow[kRadius + 1] = {0.2660117248617943f,   0.21300553771125366f, 0.1093606895097f,
                                        0.03600077212843082f, 0.007598758135239184f, 0.0010283800844791099f};

// out[i] = sum_k window[|k|] in[i + k], i in [0, n). `in` has kPad readable floats on each side.
void blur_horizontal(const float* in, float* out, std::size_t n) {
  for (std::size_t i = 0; i < n; i += kLanes) {
    Floats sum = kWindow[0] * load(in + i);
    for (int k = 1; k <= kRadius; ++k) sum += kWindow[k] * (load(in + i - k) + load(in + i + k));
    store(out + i, sum);
  }
}

// The last kTaps rows of a strip of `floats` each; row y lies at y modulo kTaps.
struct Ring {
  float* data;
  std::size_t floats;

  float* row(int y) const { return data + static_cast<std::size_t>((y + 4 * kTaps) % kTaps) * floats; }
  void clear_row(int y) const { std::memset(row(y), 0, floats * sizeof(float)); }

  // out[i] = sum_k window[|k|] row(y + k)[i]
  void blur_vertical(int y, float* out) const {
    const float* rows[kTaps];
    for (int k = 0; k < kTaps; ++k) rows[k] = row(y + k - kRadius);
    for (std::size_t i = 0; i < floats; i += kLanes) {
      Floats sum = kWindow[0] * load(rows[kRadius] + i);
      for (int k = 1; k <= kRadius; ++k) sum += kWindow[k] * (load(rows[kRadius - k] + i) + load(rows[kRadius + k] + i));
      store(out + i, sum);
    }
  }
};

struct ColorAccumulators {
  Floats absolute{}, robust{}, squared{}, gain{}, offset{}, ssim{};
};

// One channel of one band of rows.
class ColorBand {
 public:
  ColorBand(const ImageLossJob& job, const ImageLossPlanes& planes, float* rows, int channel, int begin, int end)
      : job_(job), planes_(planes), channel_(channel), begin_(begin), end_(end), n_(planes.stride),
        gain_(job.exposure[2 * channel]), offset_(job.exposure[2 * channel + 1]),
        scale_(1.f / (3.f * job.height * job.width)) {
    rows += 4 * n_;  // those of the depth image
    const auto take = [&rows](std::size_t floats) { return std::exchange(rows, rows + floats); };
    for (float*& row : source_) row = take(n_ + 2 * kPad) + kPad;
    for (float*& row : derivative_) row = take(n_ + 2 * kPad) + kPad;
    statistics_ring_ = {take(kTaps * 4 * n_), 4 * n_};
    derivative_ring_ = {take(kTaps * 3 * n_), 3 * n_};
    statistics_ = take(4 * n_);
    gradient_ = take(3 * n_);
    rendered_ = take(n_);
    output_ = take(n_);
  }

  void run(ImageLossSums& sums) {
    if (job_.dssim_weight > 0) run_with_ssim();
    else
      for (int y = begin_; y < end_; ++y) finish_row<false>(y);
    sums.absolute = total(sums_.absolute), sums.robust = total(sums_.robust), sums.squared = total(sums_.squared);
    sums.gain = total(sums_.gain), sums.offset = total(sums_.offset), sums.ssim = total(sums_.ssim);
  }

 private:
  void run_with_ssim() {
    for (int y = begin_ - 2 * kRadius; y < end_ + 2 * kRadius; ++y) {
      if (inside(y)) blur_sources(y);
      else statistics_ring_.clear_row(y);
      const int middle = y - kRadius;
      if (middle < begin_ - kRadius) continue;
      if (inside(middle)) blur_derivatives(middle);
      else derivative_ring_.clear_row(middle);
      if (y - 2 * kRadius >= begin_) finish_row<true>(y - 2 * kRadius);
    }
  }

  bool inside(int y) const { return y >= 0 && y < job_.height; }

  // Vectors read whole rows of `stride`; the caller's image ends where it ends.
  void load_rendered(int y) {
    const std::size_t width = job_.width;
    std::memcpy(rendered_, job_.image + (static_cast<std::size_t>(channel_) * job_.height + y) * width,
                width * sizeof(float));
  }

  void blur_sources(int y) {
    load_rendered(y);
    const float* target = planes_.color[channel_] + y * n_;
    const float* weight = planes_.weight + y * n_;
    for (std::size_t i = 0; i < n_; i += kLanes) {
      const Floats b = load(target + i);
      const Floats a = b + load(weight + i) * (gain_ * load(rendered_ + i) + offset_ - b);
      store(source_[0] + i, a);
      store(source_[1] + i, b);
      store(source_[2] + i, a * a + b * b);
      store(source_[3] + i, a * b);
    }
    for (int k = 0; k < 4; ++k) blur_horizontal(source_[k], statistics_ring_.row(y) + k * n_, n_);
  }

  void blur_derivatives(int y) {
    statistics_ring_.blur_vertical(y, statistics_);
    Floats sum{};
    for (std::size_t i = 0; i < n_; i += kLanes) {
      const Floats mx = load(statistics_ + i), my = load(statistics_ + n_ + i);
      const Floats squares = load(statistics_ + 2 * n_ + i), product = load(statistics_ + 3 * n_ + i);
      const Floats mxy = mx * my, mm = mx * mx + my * my;
      const Floats A = 2.f * mxy + kC1, B = 2.f * (product - mxy) + kC2;
      const Floats C = mm + kC1, D = squares - mm + kC2;
      const Floats inverse = load(planes_.columns + i) / (C * D);  // 0 beyond the image, and so is all that follows
      const Floats S = A * B * inverse;
      sum += S;
      store(derivative_[0] + i, 2.f * inverse * (my * (B - A) - mx * S * (D - C)));  // dS/dmx, E[.] held
      store(derivative_[1] + i, -2.f * S * C * inverse);                             // 2 dS/dE[x^2]
      store(derivative_[2] + i, 2.f * A * inverse);                                  // dS/dE[xy]
    }
    if (y >= begin_ && y < end_) sums_.ssim += sum;
    for (int k = 0; k < 3; ++k) blur_horizontal(derivative_[k], derivative_ring_.row(y) + k * n_, n_);
  }

  template <bool kSsim>
  void finish_row(int y) {
    if (kSsim) derivative_ring_.blur_vertical(y, gradient_);
    if (job_.charbonnier) finish_row<kSsim, true>(y);
    else finish_row<kSsim, false>(y);
  }

  template <bool kSsim, bool kCharbonnier>
  void finish_row(int y) {
    load_rendered(y);
    const float* target = planes_.color[channel_] + y * n_;
    const float* weight = planes_.weight + y * n_;
    const float* depth = planes_.depth + y * n_;
    const float robust_scale = (1.f - job_.dssim_weight) * scale_, ssim_scale = -job_.dssim_weight * scale_;
    const float epsilon = job_.charbonnier_epsilon;
    const Floats zero{}, one = zero + 1.f;
    ColorAccumulators sums = sums_;
    for (std::size_t i = 0; i < n_; i += kLanes) {
      const Floats r = load(rendered_ + i), b = load(target + i), w = load(weight + i);
      const Floats corrected = gain_ * r + offset_;
      const Floats residual = w * (corrected - b);
      Floats gradient;
      if (kCharbonnier) {
        const Floats root = square_root(residual * residual + epsilon * epsilon);
        gradient = robust_scale * residual / root;
        sums.robust += root - epsilon;
      } else {
        gradient = robust_scale * sign(residual);
      }
      if (kSsim) {
        const Floats a = b + residual;
        gradient += ssim_scale * (load(gradient_ + i) + a * load(gradient_ + n_ + i) + b * load(gradient_ + 2 * n_ + i));
      }
      gradient *= w;
      store(output_ + i, gain_ * gradient);
      const Floats clipped = corrected < 0.f ? zero : (corrected > 1.f ? one : corrected);
      const Floats error = load(depth + i) > 0.f ? clipped - b : zero;
      sums.absolute += absolute(residual);
      sums.squared += error * error;
      sums.gain += gradient * r;
      sums.offset += gradient;
    }
    sums_ = sums;
    if (!kCharbonnier) sums_.robust = sums_.absolute;
    std::memcpy(job_.d_image + (static_cast<std::size_t>(channel_) * job_.height + y) * job_.width, output_,
                job_.width * sizeof(float));
  }

  const ImageLossJob& job_;
  const ImageLossPlanes& planes_;
  const int channel_, begin_, end_;
  const std::size_t n_;
  const float gain_, offset_, scale_;
  float* source_[4];      // x, y, x^2 + y^2, x y of one row, padded
  float* derivative_[3];  // of one row, padded
  Ring statistics_ring_, derivative_ring_;
  float *statistics_, *gradient_, *rendered_, *output_;
  ColorAccumulators sums_;
};

}  // namespace

long long image_loss_prepare(const ImageLossJob& job, const ImageLossPlanes& planes, int begin, int end) {
  const int width = job.width;
  int count = 0;
  for (int y = begin; y < end; ++y) {
    const std::size_t in = static_cast<std::size_t>(y) * width, out = y * planes.stride;
    const uint8_t* __restrict color = job.target_color + 3 * in;
    float *__restrict red = planes.color[0] + out, *__restrict green = planes.color[1] + out;
    float *__restrict blue = planes.color[2] + out, *__restrict depth = planes.depth + out;
    float* __restrict weight = planes.weight + out;
    for (int x = 0; x < width; ++x) {
      red[x] = color[3 * x] * (1.f / 255);
      green[x] = color[3 * x + 1] * (1.f / 255);
      blue[x] = color[3 * x + 2] * (1.f / 255);
    }
    if (job.target_depth_is_float) {
      const float* __restrict d = static_cast<const float*>(job.target_depth) + in;
      // The comparisons are false for NaN.
      for (int x = 0; x < width; ++x) depth[x] = d[x] > 0.f && d[x] <= 3e38f ? d[x] * job.depth_scale : 0.f;
    } else {
      const uint16_t* __restrict d = static_cast<const uint16_t*>(job.target_depth) + in;
      for (int x = 0; x < width; ++x) depth[x] = d[x] * job.depth_scale;
    }
    for (int x = 0; x < width; ++x) {
      weight[x] = depth[x] > 0.f ? 1.f : job.no_depth_weight;
      count += depth[x] > 0.f;
    }
  }
  return count;
}

void image_loss_color_band(const ImageLossJob& job, const ImageLossPlanes& planes, float* rows, int channel, int begin,
                           int end, ImageLossSums& sums) {
  ColorBand(job, planes, rows, channel, begin, end).run(sums);
}

void image_loss_depth_band(const ImageLossJob& job, const ImageLossPlanes& planes, float* rows, int begin, int end,
                           ImageLossSums& sums) {
  const std::size_t n = planes.stride, width = job.width, bytes = width * sizeof(float);
  float *depth = rows, *alpha = rows + n, *d_depth = rows + 2 * n, *d_alpha = rows + 3 * n;
  const float per_pixel = job.valid_pixels > 0 ? static_cast<float>(1 / job.valid_pixels) : 0.f;
  const float depth_scale = job.depth_weight * per_pixel, opacity_scale = -job.opacity_weight * per_pixel;
  const Floats zero{}, one = zero + 1.f;
  Floats sum{}, pixels{}, transparency{};
  for (int y = begin; y < end; ++y) {
    const std::size_t at = y * width;
    std::memcpy(depth, job.depth + at, bytes);
    std::memcpy(alpha, job.alpha + at, bytes);
    for (std::size_t i = 0; i < n; i += kLanes) {
      const Floats target = load(planes.depth + y * n + i), z = load(depth + i), a = load(alpha + i);
      const Floats valid = target > 0.f ? one : zero;
      Floats used = valid, slope = valid, residual = (z - target) * valid;
      Floats toward_alpha = opacity_scale * valid;
      if (job.normalised_depth) {
        used = a >= job.minimum_alpha ? valid : zero;
        const Floats normalised = z / (used > 0.f ? a : one);
        residual = used > 0.f ? normalised - target : zero;
        slope = used > 0.f ? one / a : zero;
        toward_alpha -= depth_scale * sign(residual) * normalised * slope;
      }
      store(d_depth + i, depth_scale * sign(residual) * slope);
      store(d_alpha + i, toward_alpha);
      sum += absolute(residual);
      pixels += used;
      transparency += valid * (1.f - a);
    }
    std::memcpy(job.d_depth + at, d_depth, bytes);
    std::memcpy(job.d_alpha + at, d_alpha, bytes);
  }
  sums.depth = total(sum), sums.depth_pixels = total(pixels), sums.transparency = total(transparency);
}

}  // namespace ggslam::GGSLAM_ISA
