// SPDX-License-Identifier: Apache-2.0
// Backward of compositing a tile, back to front. With g = sum over channels of channel value times image gradient at a
// pixel, t the transmittance before the splat and "behind" the sum of weight * g over all splats behind it (starting
// from minus the final transmittance times the gradient of the alpha image):
//     d loss / d alpha = t g - behind / (1 - alpha)
// so one scalar per pixel stands for everything behind. The transmittance is recovered by dividing by 1 - alpha.
//
// d loss / d log(alpha) =: G leads to the splat's geometry through its moments sum G (1, dx, dy, dx^2, dx dy, dy^2).
// A warp sums all values of a splat over its pixels at once (warp_reduction.cuh) and adds them to the Gaussian's row of
// gradients with one coalesced atomic instruction. Everything is linear in the image gradients, so that groups of
// feature channels may be handled by launches of their own.
#pragma once
#include "tile.cuh"
#include "warp_reduction.cuh"

namespace ggslam::cuda {

constexpr int kBackwardBatch = 128;

// Where the summed gradients go.
struct GradientRows {
  float* rows;  // [N, stride]: base gradients, then features
  int stride;
  std::uint8_t* touched;  // [N]
};

// What a pixel knows while going through the splats from back to front.
template <int kFeatures>
struct PixelState {
  float x, y;
  float transmittance, behind;
  int last;
  float red, green, blue, depth;                    // image gradients
  float features[kFeatures > 0 ? kFeatures : 1];
};

__device__ inline float value_or_zero(const float* plane, bool inside, std::int64_t index) {
  return plane != nullptr && inside ? plane[index] : 0.0f;
}

template <int kFeatures>
__device__ inline PixelState<kFeatures> load_pixel(const ImageGradients& in, const PixelWorkspace& w, const Grid& grid,
                                                   const FeatureGroup& group, const Pixel& pixel) {
  const std::int64_t plane = static_cast<std::int64_t>(grid.width) * grid.height;
  PixelState<kFeatures> p;
  p.x = static_cast<float>(pixel.x), p.y = static_cast<float>(pixel.y);
  p.transmittance = pixel.inside ? w.transmittance[pixel.index] : 0.0f;
  p.last = pixel.inside ? w.last_entry[pixel.index] : -1;
  const bool base = pixel.inside && group.first == 0;  // later groups add their features' part only
  p.red = value_or_zero(in.image, base, pixel.index);
  p.green = value_or_zero(in.image, base, plane + pixel.index);
  p.blue = value_or_zero(in.image, base, 2 * plane + pixel.index);
  p.depth = value_or_zero(in.depth, base, pixel.index);
  p.behind = -p.transmittance * value_or_zero(in.alpha, base, pixel.index);
#pragma unroll
  for (int q = 0; q < kFeatures; ++q)
    p.features[q] = value_or_zero(in.features, pixel.inside && q < group.count, (group.first + q) * plane + pixel.index);
  return p;
}

// Takes one splat back out of a pixel; values: its base gradients at this pixel, then those of its features.
template <int kFeatures, bool kDetached>
__device__ inline void differentiate(const Splat& s, const float4* features, int entry, PixelState<kFeatures>& p,
                                     float (&values)[kBaseGradients + kFeatures]) {
  const float dx = p.x - s.mean_x, dy = p.y - s.mean_y;
  const float exponent = log2_alpha(s, dx, dy);
  const bool taken = exponent >= kLog2MinAlpha && entry <= p.last;
  const float unlimited = exp2f(exponent);
  const float alpha = taken ? fminf(unlimited, kMaxAlpha) : 0.0f;
  const float inverse = __fdividef(1.0f, 1.0f - alpha);
  const float before = p.transmittance * inverse, weight = alpha * before;
  float dot = p.red * s.red + p.green * s.green + p.blue * s.blue + p.depth * s.depth;
  if constexpr (!kDetached) {
#pragma unroll
    for (int quad = 0; quad < kFeatures / 4; ++quad) {
      const float4 f = features[quad];
      dot += p.features[4 * quad] * f.x + p.features[4 * quad + 1] * f.y + p.features[4 * quad + 2] * f.z +
             p.features[4 * quad + 3] * f.w;
    }
  }
  const float alpha_gradient = before * dot - inverse * p.behind;
  p.behind += weight * dot;
  p.transmittance = before;
  // At the limit kMaxAlpha, alpha does not depend on the splat's shape.
  const float G = taken && unlimited <= kMaxAlpha ? alpha * alpha_gradient : 0.0f;
  const float Gx = G * dx, Gy = G * dy;
  values[0] = G, values[1] = Gx, values[2] = Gy;
  values[3] = Gx * dx, values[4] = Gx * dy, values[5] = Gy * dy;
  values[6] = weight * p.red, values[7] = weight * p.green, values[8] = weight * p.blue, values[9] = weight * p.depth;
#pragma unroll
  for (int q = 0; q < kFeatures; ++q) values[kBaseGradients + q] = weight * p.features[q];
}

// Brings entries [first, first + n) of the tile's list to shared memory and marks the Gaussians that contributed.
template <int kFeatures>
__device__ inline void load_contributors(Batch<kBackwardBatch, kFeatures>& batch, std::uint32_t first, int n,
                                         const GaussianWorkspace& gaussians, const PairWorkspace& pairs,
                                         const GradientRows& out) {
  const int k = threadIdx.x;
  if (k >= n) return;
  const std::uint8_t warps = pairs.contributed[first + k];
  batch.warps[k] = warps;
  if (warps == 0) return;
  const std::uint32_t row = pairs.sorted_rows[first + k];
  batch.rows[k] = row;
  batch.splats[k] = gaussians.splats[row];
  out.touched[row] = 1;
}

// Highest value of all threads of the block.
__device__ inline int maximum_of_block(int value) {
  GGSLAM_SHARED int highest[kWarps];
  const int of_warp = __reduce_max_sync(kAllLanes, value);
  if (threadIdx.x % kWarp == 0) highest[threadIdx.x / kWarp] = of_warp;
  __syncthreads();
  int result = highest[0];
  for (int i = 1; i < kWarps; ++i) result = max(result, highest[i]);
  return result;
}

template <int kFeatures, bool kDetached>
__global__ void __launch_bounds__(kTileThreads, 4)
differentiate_kernel(GaussianArrays arrays, Grid grid, GaussianWorkspace gaussians, PairWorkspace pairs,
                     PixelWorkspace w, ImageGradients in, FeatureGroup group, GradientRows out) {
  GGSLAM_SHARED Batch<kBackwardBatch, kFeatures> batch;
  constexpr int kValues = kBaseGradients + kFeatures;
  const int tile = static_cast<int>(blockIdx.x), lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  PixelState<kFeatures> pixel = load_pixel<kFeatures>(in, w, grid, group, pixel_of_thread(grid, tile));
  const std::uint32_t begin = w.tile_start[tile];
  // Where the lane's sum goes in a Gaussian's row.
  const int column = lane < kBaseGradients ? lane : lane + group.first;
  const bool adds = lane < kBaseGradients + group.count;

  for (int end = maximum_of_block(pixel.last) + 1; end > 0; end -= kBackwardBatch) {
    const int first = max(end - kBackwardBatch, 0), n = end - first;
    __syncthreads();
    load_contributors<kFeatures>(batch, begin + static_cast<std::uint32_t>(first), n, gaussians, pairs, out);
    __syncthreads();
    if constexpr (kFeatures > 0 && !kDetached) {
      load_features(batch, n, arrays, group);
      __syncthreads();
    }
    for (int k0 = (n - 1) / kWarp * kWarp; k0 >= 0; k0 -= kWarp) {
      const bool mine = k0 + lane < n && ((batch.warps[k0 + lane] >> warp) & 1) != 0;
      for (unsigned left = __ballot_sync(kAllLanes, mine); left != 0;) {
        const int bit = 31 - __clz(static_cast<int>(left)), k = k0 + bit;
        left ^= 1u << bit;
        float values[kValues];
        differentiate<kFeatures, kDetached>(batch.splats[k], batch.features[k], first + k, pixel, values);
        const float sum = sum_over_warp(values, lane);
        if (adds) atomicAdd(out.rows + static_cast<std::int64_t>(batch.rows[k]) * out.stride + column, sum);
      }
    }
  }
}

}  // namespace ggslam::cuda
