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
#include "mapping/image_loss.hpp"

#include <cstring>
#include <utility>

#include "common/kernels/simd.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

// 1, 0 or -1.
inline Float sign(Float a) {
  const Float zero{}, one = zero + 1.f;
  return zero_unless(greater(a, zero), one) - zero_unless(greater(zero, a), one);
}

constexpr int kRadius = kImageLossTaps / 2, kPad = kImageLossPad, kRows = kImageLossRows;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
// exp(-k^2 / (2 1.5^2)) for k = 0..5, divided by the sum over -5..5.
constexpr float kWindow[kRadius + 1] = {0.2660117248617943f,   0.21300553771125366f, 0.1093606895097f,
                                        0.03600077212843082f, 0.007598758135239184f, 0.0010283800844791099f};

// The vector at in + kShift, where `left`, `middle` and `right` lie at in - kLanes, in and in + kLanes.
template <int kShift>
inline Float shifted(const float* in, Float left, Float middle, Float right) {
#if defined(__AVX512F__)
  // A vector that straddles two cache lines costs two loads; cutting it out of registers costs one shuffle.
  const Int low = (Int)(kShift < 0 ? left : middle), high = (Int)(kShift < 0 ? middle : right);
  return (Float)_mm512_alignr_epi32((__m512i)high, (__m512i)low, kShift & 15);
#else
  return load(in + kShift);
#endif
}

// out[i] = sum_k window[|k|] in[i + k], i in [0, n). `in` has kPad readable floats on each side.
void blur_horizontal(const float* in, float* out, std::size_t n) {
  static_assert(kRadius == 5);
  Float left = load(in - kLanes), middle = load(in);
  for (std::size_t i = 0; i < n; i += kLanes) {
    const float* p = in + i;
    const Float right = load(p + kLanes);
    Float value = kWindow[0] * middle;
    value += kWindow[1] * (shifted<-1>(p, left, middle, right) + shifted<1>(p, left, middle, right));
    value += kWindow[2] * (shifted<-2>(p, left, middle, right) + shifted<2>(p, left, middle, right));
    value += kWindow[3] * (shifted<-3>(p, left, middle, right) + shifted<3>(p, left, middle, right));
    value += kWindow[4] * (shifted<-4>(p, left, middle, right) + shifted<4>(p, left, middle, right));
    value += kWindow[5] * (shifted<-5>(p, left, middle, right) + shifted<5>(p, left, middle, right));
    store(out + i, value);
    left = middle, middle = right;
  }
}

// The rows that blurring kRows rows vertically takes, each of `floats`; row y lies at y modulo kSlots.
struct Ring {
  static constexpr int kSlots = kImageLossSlots;
  float* data;
  std::size_t floats;

  float* row(int y) const { return data + static_cast<std::size_t>((y + 2 * kSlots) % kSlots) * floats; }
  void clear_row(int y) const { std::memset(row(y), 0, floats * sizeof(float)); }

  // out[r][i] = sum_k window[|k|] row(y + r + k)[i], r in [0, kRows): together, because neighbours share their input.
  void blur_vertical(int y, float* out) const {
    const float* rows[kSlots];
    for (int k = 0; k < kSlots; ++k) rows[k] = row(y + k - kRadius);
    for (std::size_t i = 0; i < floats; i += kLanes) {
      for (int r = 0; r < kRows; ++r) {
        const float* const* middle = rows + r + kRadius;
        Float value = kWindow[0] * load(middle[0] + i);
        for (int k = 1; k <= kRadius; ++k) value += kWindow[k] * (load(middle[-k] + i) + load(middle[k] + i));
        store(out + r * floats + i, value);
      }
    }
  }
};

struct ColorAccumulators {
  Float absolute{}, robust{}, squared{}, gain{}, offset{}, ssim{};
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
    statistics_ring_ = {take(Ring::kSlots * 4 * n_), 4 * n_};
    derivative_ring_ = {take(Ring::kSlots * 3 * n_), 3 * n_};
    statistics_ = take(kRows * 4 * n_);
    gradient_ = take(kRows * 3 * n_);
    rendered_ = take(n_);
    output_ = take(n_);
  }

  void run(ImageLossSums& sums) {
    if (job_.dssim_weight > 0) run_with_ssim();
    else
      for (int y = begin_; y < end_; ++y) finish_row<false>(y, nullptr);
    sums.absolute = sum(sums_.absolute), sums.robust = sum(sums_.robust), sums.squared = sum(sums_.squared);
    sums.gain = sum(sums_.gain), sums.offset = sum(sums_.offset), sums.ssim = sum(sums_.ssim);
  }

 private:
  void run_with_ssim() {
    for (int y = begin_ - 2 * kRadius; y < end_ + 2 * kRadius; y += kRows) {
      for (int r = 0; r < kRows; ++r) blur_sources(y + r);
      const int middle = y - kRadius, last = y - 2 * kRadius;
      if (middle + kRows <= begin_ - kRadius) continue;
      statistics_ring_.blur_vertical(middle, statistics_);
      for (int r = 0; r < kRows; ++r) blur_derivatives(middle + r, statistics_ + r * 4 * n_);
      if (last + kRows <= begin_) continue;
      derivative_ring_.blur_vertical(last, gradient_);
      for (int r = 0; r < kRows; ++r)
        if (last + r >= begin_ && last + r < end_) finish_row<true>(last + r, gradient_ + r * 3 * n_);
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
    if (!inside(y)) return statistics_ring_.clear_row(y);
    load_rendered(y);
    const float* target = planes_.color[channel_] + y * n_;
    const float* weight = planes_.weight + y * n_;
    for (std::size_t i = 0; i < n_; i += kLanes) {
      const Float b = load(target + i);
      const Float a = b + load(weight + i) * (gain_ * load(rendered_ + i) + offset_ - b);
      store(source_[0] + i, a);
      store(source_[1] + i, b);
      store(source_[2] + i, a * a + b * b);
      store(source_[3] + i, a * b);
    }
    for (int k = 0; k < 4; ++k) blur_horizontal(source_[k], statistics_ring_.row(y) + k * n_, n_);
  }

  void blur_derivatives(int y, const float* statistics) {
    if (!inside(y)) return derivative_ring_.clear_row(y);
    Float ssim{};
    for (std::size_t i = 0; i < n_; i += kLanes) {
      const Float mx = load(statistics + i), my = load(statistics + n_ + i);
      const Float squares = load(statistics + 2 * n_ + i), product = load(statistics + 3 * n_ + i);
      const Float mxy = mx * my, mm = mx * mx + my * my;
      const Float A = 2.f * mxy + kC1, B = 2.f * (product - mxy) + kC2;
      // Rounding can make the variances negative where colours are far outside [0, 1].
      const Float C = mm + kC1, D = maximum(squares - mm, Float{}) + kC2;
      const Float inverse = load(planes_.columns + i) / (C * D);  // 0 beyond the image, and so is all that follows
      const Float S = A * B * inverse;
      ssim += S;
      store(derivative_[0] + i, 2.f * inverse * (my * (B - A) - mx * S * (D - C)));  // dS/dmx, E[.] held
      store(derivative_[1] + i, -2.f * S * C * inverse);                             // 2 dS/dE[x^2]
      store(derivative_[2] + i, 2.f * A * inverse);                                  // dS/dE[xy]
    }
    if (y >= begin_ && y < end_) sums_.ssim += ssim;
    for (int k = 0; k < 3; ++k) blur_horizontal(derivative_[k], derivative_ring_.row(y) + k * n_, n_);
  }

  template <bool kSsim>
  void finish_row(int y, const float* ssim_gradient) {
    if (job_.charbonnier) finish_row<kSsim, true>(y, ssim_gradient);
    else finish_row<kSsim, false>(y, ssim_gradient);
  }

  template <bool kSsim, bool kCharbonnier>
  void finish_row(int y, const float* ssim_gradient) {
    load_rendered(y);
    const float* target = planes_.color[channel_] + y * n_;
    const float* weight = planes_.weight + y * n_;
    const float* depth = planes_.depth + y * n_;
    const float robust_scale = (1.f - job_.dssim_weight) * scale_, ssim_scale = -job_.dssim_weight * scale_;
    const float epsilon = job_.charbonnier_epsilon;
    const Float zero{}, one = zero + 1.f;
    ColorAccumulators sums = sums_;
    for (std::size_t i = 0; i < n_; i += kLanes) {
      const Float r = load(rendered_ + i), b = load(target + i), w = load(weight + i);
      const Float corrected = gain_ * r + offset_;
      const Float residual = w * (corrected - b);
      Float gradient;
      if (kCharbonnier) {
        const Float root = square_root(residual * residual + epsilon * epsilon);
        gradient = robust_scale * residual / root;
        sums.robust += root - epsilon;
      } else {
        gradient = robust_scale * sign(residual);
      }
      if (kSsim) {
        const Float a = b + residual;
        const float* g = ssim_gradient + i;
        gradient += ssim_scale * (load(g) + a * load(g + n_) + b * load(g + 2 * n_));
      }
      gradient *= w;
      store(output_ + i, gain_ * gradient);
      const Float error = zero_unless(greater(load(depth + i), zero), clamp(corrected, zero, one) - b);
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

// The compiler vectorises the loops below where pixels follow one another; GCC trusts __restrict on parameters only.
template <int kStep>
void planar_color(const uint8_t* __restrict color, int step, float* __restrict red, float* __restrict green,
                  float* __restrict blue, int width) {
  const int next = 3 * (kStep > 0 ? kStep : step);
  for (int x = 0; x < width; ++x) {
    red[x] = color[next * x] * (1.f / 255);
    green[x] = color[next * x + 1] * (1.f / 255);
    blue[x] = color[next * x + 2] * (1.f / 255);
  }
}

inline float known_depth(uint16_t units) { return units; }
inline float known_depth(float units) { return units > 0.f && units <= 3e38f ? units : 0.f; }  // 0 for NaN too

template <typename Unit, int kStep>
void metric_depth(const Unit* __restrict units, int step, float scale, float* __restrict depth, int width) {
  const int next = kStep > 0 ? kStep : step;
  for (int x = 0; x < width; ++x) depth[x] = known_depth(units[next * x]) * scale;
}

// What a target does not show counts for nothing.
void drop_invalid(const uint8_t* __restrict valid, int step, float* __restrict weight, int width) {
  for (int x = 0; x < width; ++x) weight[x] = valid[step * x] != 0 ? weight[x] : 0.f;
}

// Returns the number of pixels with depth.
int color_weight(const float* __restrict depth, float no_depth_weight, float* __restrict weight, int width) {
  int count = 0;
  for (int x = 0; x < width; ++x) {
    weight[x] = depth[x] > 0.f ? 1.f : no_depth_weight;
    count += depth[x] > 0.f;
  }
  return count;
}

// kStep: the target's pixels from one to the next, 0: as the job says.
template <int kStep>
long long prepare_rows(const ImageLossJob& job, const ImageLossPlanes& planes, int begin, int end) {
  const int width = job.width, step = job.target_step;
  long long count = 0;
  for (int y = begin; y < end; ++y) {
    const std::size_t in = static_cast<std::size_t>(y) * job.target_row, out = y * planes.stride;
    float* const depth = planes.depth + out;
    planar_color<kStep>(job.target_color + 3 * in, step, planes.color[0] + out, planes.color[1] + out,
                        planes.color[2] + out, width);
    if (job.target_depth_is_float) {
      metric_depth<float, kStep>(static_cast<const float*>(job.target_depth) + in, step, job.depth_scale, depth, width);
    } else {
      metric_depth<uint16_t, kStep>(static_cast<const uint16_t*>(job.target_depth) + in, step, job.depth_scale, depth,
                                    width);
    }
    count += color_weight(depth, job.no_depth_weight, planes.weight + out, width);
    if (job.target_valid != nullptr) drop_invalid(job.target_valid + in, step, planes.weight + out, width);
  }
  return count;
}

}  // namespace

long long image_loss_prepare(const ImageLossJob& job, const ImageLossPlanes& planes, int begin, int end) {
  return job.target_step == 1 ? prepare_rows<1>(job, planes, begin, end) : prepare_rows<0>(job, planes, begin, end);
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
  const Float zero{}, one = zero + 1.f;
  Float depth_sum{}, pixels{}, transparency{};
  for (int y = begin; y < end; ++y) {
    const std::size_t at = y * width;
    std::memcpy(depth, job.depth + at, bytes);
    std::memcpy(alpha, job.alpha + at, bytes);
    for (std::size_t i = 0; i < n; i += kLanes) {
      const Float target = load(planes.depth + y * n + i), z = load(depth + i), a = load(alpha + i);
      const Mask valid = greater(target, zero);
      Mask used = valid;
      Float measured = z, slope = one, d_alpha_through_depth = zero;
      if (job.normalised_depth) {
        used = both(valid, greater_equal(a, broadcast(job.minimum_alpha)));
        slope = 1.f / select(used, a, one);
        measured = z * slope;
        d_alpha_through_depth = -measured * slope;
      }
      const Float residual = zero_unless(used, measured - target), toward = depth_scale * sign(residual);
      store(d_depth + i, toward * slope);
      store(d_alpha + i, zero_unless(valid, toward * d_alpha_through_depth + opacity_scale));
      depth_sum += absolute(residual);
      pixels += zero_unless(used, one);
      transparency += zero_unless(valid, one - a);
    }
    std::memcpy(job.d_depth + at, d_depth, bytes);
    std::memcpy(job.d_alpha + at, d_alpha, bytes);
  }
  sums.depth = sum(depth_sum), sums.depth_pixels = sum(pixels), sums.transparency = sum(transparency);
}

}  // namespace ggslam::GGSLAM_ISA
