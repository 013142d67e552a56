// SPDX-License-Identifier: Apache-2.0
// Backward of compositing a tile, back to front. With g = sum over channels of channel value times image gradient at a
// pixel, t the transmittance before the splat and "behind" the sum of weight * g over all splats behind it (starting
// from minus the final transmittance times the gradient of the alpha image):
//     d loss / d alpha = t g - behind / (1 - alpha)
// so one scalar per pixel stands for everything behind. The transmittance is recovered by dividing by 1 - alpha.
//
// d loss / d log(alpha) =: G leads to the splat's geometry through its moments sum G (1, r, dy, r^2, r dy, dy^2), r of the splat.
// Sums over a warp's pixels are the business of gradient_queue.cuh. Everything is linear in the image gradients, so that
// groups of feature channels may be handled by launches of their own.
#pragma once
#include "rendering/gradient_queue.cuh"

namespace ggslam::cuda {

// Splats brought to shared memory at a time; with many features less, for that memory's sake.
template <int kFeatures>
constexpr int kBackwardBatch = kFeatures > 8 ? 64 : 128;

// What a pixel knows while going through the splats from back to front.
template <int kFeatures>
struct PixelState {
  float x, y;
  float transmittance, behind;
  int last;  // twice the number of the last splat, and 1 if that one has closed the pixel
  float red, green, blue, depth;                    // image gradients
  float features[kFeatures > 0 ? kFeatures : 1];
};

__device__ inline float value_or_zero(const float* plane, bool inside, std::int64_t index) {
  return plane != nullptr && inside ? plane[index] : 0.0f;
}

// complete: no pairs were dropped. Otherwise no Gaussian counts as having contributed: without the pairs that found no
// room gradients would be wrong, and so none are formed, no Gaussian is touched and the twist stays zero.
template <int kFeatures>
__device__ inline PixelState<kFeatures> load_pixel(const ImageGradients& in, const PixelWorkspace& w, const Grid& grid,
                                                   const FeatureGroup& group, const Pixel& pixel, bool complete) {
  const std::int64_t plane = static_cast<std::int64_t>(grid.width) * grid.height;
  PixelState<kFeatures> p;
  p.x = static_cast<float>(pixel.x), p.y = static_cast<float>(pixel.y);
  const float left = pixel.inside ? w.transmittance[pixel.index] : 0.0f;
  p.transmittance = fabsf(left);
  p.last = 2 * (pixel.inside && complete ? w.last_entry[pixel.index] : -1) + (left < 0.0f ? 1 : 0);
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

// A splat's weight at a pixel, and its G = d loss / d log(alpha).
struct Contribution {
  float weight, log_alpha;
};

// Takes one splat back out of a pixel.
template <int kFeatures, bool kDetached>
__device__ inline Contribution differentiate(const Splat& s, const float4* features, int entry,
                                             PixelState<kFeatures>& p) {
  float exponent = log2_alpha(s, p.x - s.mean_x, p.y - s.mean_y);
  // The splat that closed a pixel counts as one of full opacity, to which the limit kMaxAlpha applies.
  if (2 * entry + 1 == p.last) exponent = 0.0f;
  if (2 * entry > p.last) exponent = 2.0f * kLog2MinAlpha;  // behind the last one
  const bool taken = exponent >= kLog2MinAlpha;
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
  return {weight, taken && unlimited <= kMaxAlpha ? alpha * alpha_gradient : 0.0f};
}

// Leaves a pixel's image gradients in shared memory for the sums.
template <int kFeatures>
__device__ inline void share_image_gradients(const PixelState<kFeatures>& p, float* out) {
  out[0] = p.red, out[1] = p.green, out[2] = p.blue, out[3] = p.depth;
#pragma unroll
  for (int q = 0; q < kFeatures; ++q) out[kBaseChannels + q] = p.features[q];
}

// Brings entries [first, first + n) of the tile's list to shared memory and marks the Gaussians that contributed.
template <int kBatch, int kFeatures>
__device__ inline void load_contributors(Batch<kBatch, kFeatures>& batch, std::uint32_t first, int n,
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
__global__ void __launch_bounds__(kTileThreads, kFeatures > 0 ? 3 : 4)
differentiate_kernel(GaussianArrays arrays, Grid grid, GaussianWorkspace gaussians, PairWorkspace pairs,
                     PixelWorkspace w, ImageGradients in, FeatureGroup group, GradientRows out) {
  constexpr int kBatch = kBackwardBatch<kFeatures>;
  GGSLAM_SHARED Batch<kBatch, kFeatures> batch;
  GGSLAM_SHARED WarpQueue<kFeatures> queues[kWarps];
  const int tile = static_cast<int>(blockIdx.x), lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  PixelState<kFeatures> pixel = load_pixel<kFeatures>(in, w, grid, group, pixel_of_thread(grid, tile),
                                                      !out_of_room(gaussians, pairs));
  WarpQueue<kFeatures>& queue = queues[warp];
  share_image_gradients(pixel, queue.pixel(lane));
  int queued = 0;

  for (int end = (maximum_of_block(pixel.last) >> 1) + 1; end > 0; end -= kBatch) {
    const int first = max(end - kBatch, 0), n = end - first;
    __syncthreads();
    // The list's start is read anew for each batch rather than kept in a register all along.
    load_contributors(batch, w.tile_start[tile] + static_cast<std::uint32_t>(first), n, gaussians, pairs, out);
    __syncthreads();
    if constexpr (kFeatures > 0 && !kDetached) {
      load_features(batch, n, arrays, group);
      __syncthreads();
    }
    for (int k0 = (n - 1) / kWarp * kWarp; k0 >= 0; k0 -= kWarp) {
      const bool concerned = k0 + lane < n && ((batch.warps[k0 + lane] >> warp) & 1) != 0;
      for (unsigned open = __ballot_sync(kAllLanes, concerned); open != 0;) {
        const int bit = 31 - __clz(static_cast<int>(open)), k = k0 + bit;
        open ^= 1u << bit;
        const Splat& splat = batch.splats[k];
        const Contribution c = differentiate<kFeatures, kDetached>(splat, batch.features[k], first + k, pixel);
        queue.weights[queued * kQueueStride + lane] = c.weight;
        queue.log_alphas[queued * kQueueStride + lane] = c.log_alpha;
        if (lane == 0) queue.splats[queued] = {splat.mean_x, splat.mean_y, splat.slope_x, batch.rows[k]};
        if (++queued < kQueued) continue;
        empty_queue(queue, queued, pixel.x, pixel.y, group, out);
        queued = 0;
      }
    }
  }
  if (queued > 0) empty_queue(queue, queued, pixel.x, pixel.y, group, out);
}

}  // namespace ggslam::cuda
