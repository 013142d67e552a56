// SPDX-License-Identifier: Apache-2.0
// L1 (or Charbonnier) + SSIM of colour, L1 of depth, and their gradients.
//
// SSIM (Wang et al. 2004) needs neighbours twice: for the statistics of a pixel, and for the gradient, to which the
// derivatives at all pixels around contribute (see native/src/mapping/kernels/image_loss.cpp). So one kernel writes three
// derivatives per value, blurring x, y, x^2 + y^2 and x y, and another blurs those and does all that is local.
#pragma once
#include "mapping/loss_tile.cuh"

namespace ggslam::cuda {

constexpr float kSsimC1 = 0.01f * 0.01f, kSsimC2 = 0.03f * 0.03f;
constexpr int kCollectThreads = kSumRows * kWarp;

__global__ void __launch_bounds__(kLossThreads) count_depth_kernel(ImageLossJob job, LossWorkspace w) {
  take_target(job);
  const std::int64_t pixel = static_cast<std::int64_t>(blockIdx.x) * kLossThreads + threadIdx.x;
  const bool inside = pixel < static_cast<std::int64_t>(job.height) * job.width;
  const int count = __syncthreads_count(inside && target_depth(job, pixel) > 0.0f);
  if (threadIdx.x == 0 && count > 0) atomicAdd(w.valid_pixels, static_cast<std::uint32_t>(count));
}

// SSIM of a value and its derivatives with respect to mx, E[x^2] (twice) and E[xy]. statistics: E of x, y, x^2 + y^2, xy.
__device__ inline float differentiate_ssim(const float statistics[4], float derivatives[3]) {
  const float mx = statistics[0], my = statistics[1], mxy = mx * my, mm = mx * mx + my * my;
  const float A = 2.0f * mxy + kSsimC1, B = 2.0f * (statistics[3] - mxy) + kSsimC2;
  // Rounding can make the variances negative where colours are far outside [0, 1].
  const float C = mm + kSsimC1, D = fmaxf(statistics[2] - mm, 0.0f) + kSsimC2;
  const float inverse = 1.0f / (C * D), S = A * B * inverse;
  derivatives[0] = 2.0f * inverse * (my * (B - A) - mx * S * (D - C));
  derivatives[1] = -2.0f * S * C * inverse;
  derivatives[2] = 2.0f * A * inverse;
  return S;
}

// Blurs the four kinds along a row of the halo's pixels, of which `x` and `y` are the first that count.
__device__ inline void blur_sources(const float* x, const float* y, float out[4]) {
  float a[kBlurTaps], b[kBlurTaps], squares[kBlurTaps], products[kBlurTaps];
#pragma unroll
  for (int i = 0; i < kBlurTaps; ++i) {
    a[i] = x[i], b[i] = y[i];
    squares[i] = a[i] * a[i] + b[i] * b[i];
    products[i] = a[i] * b[i];
  }
  out[0] = blur(a), out[1] = blur(b), out[2] = blur(squares), out[3] = blur(products);
}

// One tile of one channel.
__global__ void __launch_bounds__(kLossThreads)
similarity_kernel(ImageLossJob job, LossTiles tiles, LossWorkspace w) {
  take_target(job);
  GGSLAM_SHARED float rendered[kHaloHigh][kHaloWide], target[kHaloHigh][kHaloWide];
  GGSLAM_SHARED BlurredRows rows[4];
  const LossTile tile = tile_of_block(tiles);
  const Exposure exposure = exposure_of(job, tile.channel);
  for (int k = threadIdx.x; k < kHaloHigh * kHaloWide; k += kLossThreads) {
    const int column = k % kHaloWide, row = k / kHaloWide;
    const int x = tile.x + column - kBlurRadius, y = tile.y + row - kBlurRadius;
    ColorPair p = {};
    if (is_inside(job, x, y)) p = color_pair(job, exposure, tile.channel, pixel_index(job, x, y));
    rendered[row][column] = p.target + p.residual;
    target[row][column] = p.target;
  }
  __syncthreads();
  for (int k = threadIdx.x; k < kHaloHigh * kLossTileWide; k += kLossThreads) {
    const int column = k % kLossTileWide, row = k / kLossTileWide;
    float blurred[4];
    blur_sources(&rendered[row][column], &target[row][column], blurred);
    for (int kind = 0; kind < 4; ++kind) rows[kind][row][column] = blurred[kind];
  }
  __syncthreads();
  float statistics[4][kPixelsPerThread], similarity[1] = {0.0f};
#pragma unroll
  for (int kind = 0; kind < 4; ++kind) blur_column(rows[kind], statistics[kind]);
  const std::int64_t plane = static_cast<std::int64_t>(job.height) * job.width;
#pragma unroll
  for (int i = 0; i < kPixelsPerThread; ++i) {
    const int x = tile.x + column_of_thread(), y = tile.y + row_of_thread() + i;
    if (!is_inside(job, x, y)) continue;
    const float at_pixel[4] = {statistics[0][i], statistics[1][i], statistics[2][i], statistics[3][i]};
    float derivatives[3];
    similarity[0] += differentiate_ssim(at_pixel, derivatives);
    float* out = w.derivatives + 3 * tile.channel * plane + pixel_index(job, x, y);
    for (int kind = 0; kind < 3; ++kind) out[kind * plane] = derivatives[kind];
  }
  write_block_sums(similarity, w.sums + (3 * kSimilarity + tile.channel) * tiles.count() + tile.number, 1);
}

// Blurs the derivatives of a tile. out[kind][i]: for the thread's pixel i.
__device__ inline void blur_derivatives(const ImageLossJob& job, const LossTile& tile, const float* derivatives,
                                        float (&out)[3][kPixelsPerThread]) {
  GGSLAM_SHARED float values[3][kHaloHigh][kHaloWide];
  GGSLAM_SHARED BlurredRows rows[3];
  const std::int64_t plane = static_cast<std::int64_t>(job.height) * job.width;
  for (int k = threadIdx.x; k < kHaloHigh * kHaloWide; k += kLossThreads) {
    const int column = k % kHaloWide, row = k / kHaloWide;
    const int x = tile.x + column - kBlurRadius, y = tile.y + row - kBlurRadius;
    const bool inside = is_inside(job, x, y);
    const float* in = derivatives + 3 * tile.channel * plane + (inside ? pixel_index(job, x, y) : 0);
    for (int kind = 0; kind < 3; ++kind) values[kind][row][column] = inside ? in[kind * plane] : 0.0f;
  }
  __syncthreads();
  for (int k = threadIdx.x; k < 3 * kHaloHigh * kLossTileWide; k += kLossThreads) {
    const int column = k % kLossTileWide, row = k / kLossTileWide % kHaloHigh, kind = k / (kLossTileWide * kHaloHigh);
    rows[kind][row][column] = blur(&values[kind][row][column]);
  }
  __syncthreads();
#pragma unroll
  for (int kind = 0; kind < 3; ++kind) blur_column(rows[kind], out[kind]);
}

// d loss / d residual of the robust term; adds the term to its sum.
__device__ inline float differentiate_robust(const ImageLossJob& job, float scale, float residual, float& sum) {
  if (job.charbonnier == 0) {
    sum += fabsf(residual);
    return scale * sign_of(residual);
  }
  const float root = sqrtf(residual * residual + job.charbonnier_epsilon * job.charbonnier_epsilon);
  sum += root - job.charbonnier_epsilon;
  return scale * residual / root;
}

// Colour terms of one tile of one channel.
template <bool kSsim>
__global__ void __launch_bounds__(kLossThreads) color_kernel(ImageLossJob job, LossTiles tiles, LossWorkspace w) {
  take_target(job);
  const LossTile tile = tile_of_block(tiles);
  const Exposure exposure = exposure_of(job, tile.channel);
  float blurred[3][kPixelsPerThread] = {};
  if constexpr (kSsim) blur_derivatives(job, tile, w.derivatives, blurred);
  const std::int64_t plane = static_cast<std::int64_t>(job.height) * job.width;
  const float scale = 1.0f / (3.0f * static_cast<float>(job.height) * static_cast<float>(job.width));
  const float robust_scale = (1.0f - job.dssim_weight) * scale, ssim_scale = -job.dssim_weight * scale;
  float sums[kSimilarity] = {};
#pragma unroll
  for (int i = 0; i < kPixelsPerThread; ++i) {
    const int x = tile.x + column_of_thread(), y = tile.y + row_of_thread() + i;
    if (!is_inside(job, x, y)) continue;
    const std::int64_t pixel = pixel_index(job, x, y);
    const ColorPair p = color_pair(job, exposure, tile.channel, pixel);
    float gradient = differentiate_robust(job, robust_scale, p.residual, sums[kRobust]);
    if constexpr (kSsim)
      gradient += ssim_scale * (blurred[0][i] + (p.target + p.residual) * blurred[1][i] + p.target * blurred[2][i]);
    gradient *= p.weight;
    job.d_image[tile.channel * plane + pixel] = exposure.gain * gradient;
    const float error = p.depth > 0.0f ? fminf(fmaxf(p.corrected, 0.0f), 1.0f) - p.target : 0.0f;
    sums[kAbsolute] += fabsf(p.residual);
    sums[kSquared] += error * error;
    sums[kGain] += gradient * p.rendered;
    sums[kOffset] += gradient;
  }
  write_block_sums(sums, w.sums + tile.channel * tiles.count() + tile.number, 3 * tiles.count());
}

// Depth and opacity terms of one tile.
__global__ void __launch_bounds__(kLossThreads) depth_kernel(ImageLossJob job, LossTiles tiles, LossWorkspace w) {
  take_target(job);
  const LossTile tile = tile_of_block(tiles);
  const std::uint32_t count = *w.valid_pixels;
  const float per_pixel = count > 0 ? 1.0f / static_cast<float>(count) : 0.0f;
  const float depth_scale = job.depth_weight * per_pixel, opacity_scale = -job.opacity_weight * per_pixel;
  float sums[3] = {};
#pragma unroll
  for (int i = 0; i < kPixelsPerThread; ++i) {
    const int x = tile.x + column_of_thread(), y = tile.y + row_of_thread() + i;
    if (!is_inside(job, x, y)) continue;
    const std::int64_t pixel = pixel_index(job, x, y);
    const float target = target_depth(job, pixel), z = job.depth[pixel], alpha = job.alpha[pixel];
    const bool valid = target > 0.0f, normalised = job.normalised_depth != 0;
    const bool used = valid && (!normalised || alpha >= job.minimum_alpha);
    const float slope = normalised && used ? 1.0f / alpha : 1.0f, measured = z * slope;
    const float residual = used ? measured - target : 0.0f, toward = depth_scale * sign_of(residual);
    job.d_depth[pixel] = toward * slope;
    job.d_alpha[pixel] = valid ? opacity_scale - (normalised ? toward * measured * slope : 0.0f) : 0.0f;
    sums[0] += fabsf(residual);
    sums[1] += used ? 1.0f : 0.0f;
    sums[2] += valid ? 1.0f - alpha : 0.0f;
  }
  write_block_sums(sums, w.sums + kDepthSumRow * tiles.count() + tile.number, tiles.count());
}

__device__ inline double over_channels(const double* totals, LossSum kind) {
  return totals[3 * kind] + totals[3 * kind + 1] + totals[3 * kind + 2];
}

__device__ inline void write_results(const ImageLossJob& job, const double* totals, double valid) {
  const double nothing = static_cast<double>(NAN), values = 3.0 * job.height * job.width;
  const double *depth = totals + kDepthSumRow, dssim = static_cast<double>(job.dssim_weight);
  double* r = job.results;
  r[kL1] = over_channels(totals, kAbsolute) / values;
  r[kColor] = over_channels(totals, kRobust) / values;
  r[kSsim] = dssim > 0 ? over_channels(totals, kSimilarity) / values : nothing;
  r[kDepth] = valid > 0 ? depth[0] / valid : 0;
  r[kOpacity] = valid > 0 ? depth[2] / valid : 0;
  r[kDepthL1] = depth[1] > 0 ? depth[0] / depth[1] : nothing;
  r[kPsnr] = valid > 0 ? -10 * log10(over_channels(totals, kSquared) / (3 * valid)) : nothing;
  r[kValidPixels] = valid;
  double total = (1.0 - dssim) * r[kColor] + static_cast<double>(job.depth_weight) * r[kDepth] +
                 static_cast<double>(job.opacity_weight) * r[kOpacity];
  if (dssim > 0) total += dssim * (1.0 - r[kSsim]);
  r[kTotal] = total;
  for (int channel = 0; channel < 3; ++channel) {
    r[kExposureGradient + 2 * channel] = totals[3 * kGain + channel];
    r[kExposureGradient + 2 * channel + 1] = totals[3 * kOffset + channel];
  }
}

// Adds up the tiles' sums, a warp for each kind. One block.
__global__ void __launch_bounds__(kCollectThreads)
collect_kernel(ImageLossJob job, LossTiles tiles, LossWorkspace w) {
  GGSLAM_SHARED double totals[kSumRows];
  const int lane = threadIdx.x % kWarp, row = threadIdx.x / kWarp;
  double sum = 0.0;
  for (int i = lane; i < tiles.count(); i += kWarp) sum += w.sums[static_cast<std::int64_t>(row) * tiles.count() + i];
  for (int bits = kWarp / 2; bits > 0; bits /= 2) sum += __shfl_xor_sync(kAllLanes, sum, bits);
  if (lane == 0) totals[row] = sum;
  __syncthreads();
  if (threadIdx.x == 0) write_results(job, totals, static_cast<double>(*w.valid_pixels));
}

}  // namespace ggslam::cuda
