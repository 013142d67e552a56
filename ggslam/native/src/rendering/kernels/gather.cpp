// SPDX-License-Identifier: Apache-2.0
// Sums each Gaussian's gradient slots, differentiates its projection, then either writes the gradients or applies Adam
// at once, so that no gradient array is ever written or read.
#include "rendering/kernels/adam.hpp"
#include "rendering/kernels/projection_backward.hpp"
#include "rendering/kernels/view_colour.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

constexpr int kMaxShColumns = 48;

// A vector of touched Gaussians on their way out.
struct Group {
  std::int32_t rows[kLanes];
  int n = 0;
  alignas(64) float sums[kBaseGradients][kLanes];  // summed slots
};

// Gradients as rows, the layout of the parameter arrays.
struct GradientRows {
  alignas(64) float means[kLanes * 3], quaternions[kLanes * 4], log_scales[kLanes * 3], opacity_logits[kLanes];
  alignas(64) float sh[kLanes * kMaxShColumns];
};

// Interleaves kWidth vectors to rows [kLanes][stride].
template <int kWidth>
inline void to_rows(const Float* vectors, float* rows, int stride = kWidth) {
  for (int k = 0; k < kWidth; ++k) {
    alignas(64) float values[kLanes];
    store(values, vectors[k]);
    for (int lane = 0; lane < kLanes; ++lane) rows[lane * stride + k] = values[lane];
  }
}

SplatGradients splat_gradients(const Group& group) {
  const auto& s = group.sums;
  return {load(s[0]), load(s[1]), load(s[2]), load(s[3]), load(s[4]), load(s[5]),
          {load(s[6]), load(s[7]), load(s[8])}, load(s[9])};
}

void differentiate_group(const Rasterizer& r, const ViewConstants& c, const Group& group, GradientRows& out,
                         double* twist) {
  const GaussianArrays& arrays = r.gaussians;
  const RawGaussians raw = load_gaussians(arrays, group.rows, group.n);
  const Projection p = project(c, raw);
  SplatGradients g = splat_gradients(group);
  differentiate_cut_at_black(arrays, c, group.rows, group.n, p.position, g.colour);
  Float basis[16], direction_gradient[3];
  differentiate_view_colour(arrays, c, group.rows, group.n, p.position, g.colour, basis, direction_gradient);
  const ParameterGradients grad = differentiate_projection(c, raw, p, g, direction_gradient);
  to_rows<3>(grad.mean, out.means);
  to_rows<4>(grad.quaternion, out.quaternions);
  to_rows<3>(grad.log_scale, out.log_scales);
  store(out.opacity_logits, grad.opacity_logit);
  const int columns = 3 * arrays.sh_coefficients;
  for (int k = 0; k < arrays.sh_coefficients; ++k) {
    const Float b = k < arrays.active_sh_coefficients ? basis[k] : Float{};
    const Float values[3] = {b * g.colour[0], b * g.colour[1], b * g.colour[2]};
    to_rows<3>(values, out.sh + 3 * k, columns);
  }
  for (int k = 0; k < 6; ++k) {
    Float in_use = grad.twist[k];
    for (int lane = group.n; lane < kLanes; ++lane) in_use[lane] = 0.0f;
    twist[k] += static_cast<double>(sum(in_use));
  }
}

inline void write_rows(float* array, int width, const Group& group, const float* rows, int stride) {
  for (int i = 0; i < group.n; ++i)
    __builtin_memcpy(array + static_cast<std::size_t>(group.rows[i]) * width, rows + i * stride, sizeof(float) * width);
}

void write_gradients(const Rasterizer& r, const Group& group, const GradientRows& rows, const float* features,
                     const GaussianGradients& out) {
  write_rows(out.means, 3, group, rows.means, 3);
  write_rows(out.quaternions, 4, group, rows.quaternions, 4);
  write_rows(out.log_scales, 3, group, rows.log_scales, 3);
  write_rows(out.opacity_logits, 1, group, rows.opacity_logits, 1);
  const int columns = 3 * r.gaussians.sh_coefficients;
  write_rows(out.sh, columns, group, rows.sh, columns);
  if (r.padded_features > 0)
    write_rows(out.features, r.gaussians.feature_channels, group, features, r.padded_features);
}

void apply_adam(const Rasterizer& r, const Group& group, const GradientRows& rows, const float* features,
                const AdamArguments& adam) {
  const AdamRows updated = count_updates(adam, group.rows, group.n);
  adam_narrow<3>(adam, adam.means, 3, updated, kMeans, rows.means);
  adam_narrow<4>(adam, adam.quaternions, 4, updated, kQuaternions, rows.quaternions);
  adam_narrow<3>(adam, adam.log_scales, 3, updated, kLogScales, rows.log_scales);
  adam_narrow<1>(adam, adam.opacity_logits, 1, updated, kOpacityLogits, rows.opacity_logits);
  const int columns = 3 * r.gaussians.sh_coefficients;
  if (columns == 3) {
    adam_narrow<3>(adam, adam.sh, 3, updated, kShConstant, rows.sh);
  } else {
    adam_wide(adam, adam.sh, columns, 0, 3, updated, kShConstant, rows.sh, columns);
    adam_wide(adam, adam.sh, columns, 3, columns, updated, kShRest, rows.sh, columns);
  }
  if (r.padded_features > 0)
    adam_wide(adam, adam.features, r.gaussians.feature_channels, 0, r.gaussians.feature_channels, updated, kFeatures,
              features, r.padded_features);
}

inline __attribute__((always_inline)) void prefetch_adam(const Rasterizer& r, const AdamArguments& adam,
                                                         std::size_t row) {
  prefetch_row(adam.means, row, 3), prefetch_row(adam.quaternions, row, 4), prefetch_row(adam.log_scales, row, 3);
  prefetch_row(adam.opacity_logits, row, 1), prefetch_row(adam.sh, row, 3 * r.gaussians.sh_coefficients);
  if (r.padded_features > 0) prefetch_row(adam.features, row, r.gaussians.feature_channels);
}

// Adds up the slots of one splat; false if no tile used it.
inline bool sum_slots(const Rasterizer& r, const Splat& splat, std::size_t first, Group& group, float* features) {
  const int pairs = splat.tiles.wide * splat.tiles.high, channels = r.padded_features;
  alignas(64) float total[kSlotStride] = {};
  bool touched = false;
  for (int j = 0; j < pairs; ++j) {
    const std::size_t pair = first + static_cast<std::size_t>(j);
    if (!r.slot_used[pair]) continue;
    const float* slot = r.slots.data() + pair * kSlotStride;
    for (int q = 0; q < 12; ++q) total[q] += slot[q];
    const float* feature_slot = r.feature_slots.data() + pair * channels;
    for (int q = 0; q < channels; ++q) features[q] = touched ? features[q] + feature_slot[q] : feature_slot[q];
    touched = true;
  }
  if (touched)
    for (int q = 0; q < kBaseGradients; ++q) group.sums[q][group.n] = total[q];
  return touched;
}

void clear_gradients(const Rasterizer& r, std::int64_t begin, std::int64_t end, const GaussianGradients& out) {
  const auto clear = [&](float* array, int width) {
    if (array != nullptr) __builtin_memset(array + begin * width, 0, sizeof(float) * width * (end - begin));
  };
  clear(out.means, 3), clear(out.quaternions, 4), clear(out.log_scales, 3), clear(out.opacity_logits, 1);
  clear(out.sh, 3 * r.gaussians.sh_coefficients), clear(out.features, r.gaussians.feature_channels);
  __builtin_memset(out.touched + begin, 0, end - begin);
}

}  // namespace

void gather_block(Rasterizer& r, int block, const GaussianGradients& gradients, const AdamArguments* adam,
                  ThreadScratch& scratch) {
  const ViewConstants c = view_constants(r.view);
  double twist[6] = {};
  const std::int64_t begin = r.block_begin(block);
  clear_gradients(r, begin, r.block_end(block), gradients);
  Group group;
  GradientRows rows;
  float* features = scratch.gaussian_features.data();  // [kLanes][padded_features]
  const auto flush = [&] {
    differentiate_group(r, c, group, rows, twist);
    if (adam != nullptr) apply_adam(r, group, rows, features, *adam);
    if (gradients.means != nullptr) write_gradients(r, group, rows, features, gradients);
    group.n = 0;
  };
  for (int i = 0; i < r.visible[block]; ++i) {
    const Splat& splat = r.splats[begin + i];
    const std::size_t first = r.pairs[block] + splat.first_pair;
    if (!sum_slots(r, splat, first, group, features + group.n * r.padded_features)) continue;
    gradients.touched[splat.gaussian] = 1;
    if (adam != nullptr) prefetch_adam(r, *adam, splat.gaussian);
    group.rows[group.n++] = splat.gaussian;
    if (group.n == kLanes) flush();
  }
  if (group.n > 0) {
    for (auto& sums : group.sums)
      for (int lane = group.n; lane < kLanes; ++lane) sums[lane] = 0.0f;
    flush();
  }
  for (int k = 0; k < 6; ++k) r.block_twist[6 * block + k] = twist[k];
}

}  // namespace ggslam::GGSLAM_ISA
