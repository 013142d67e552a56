// SPDX-License-Identifier: Apache-2.0
// Sums each Gaussian's gradient slots, differentiates its projection, then either writes the gradients or applies Adam
// at once, so that no gradient array is ever written or read.
#include "rendering/kernels/adam.hpp"
#include "rendering/kernels/projection_math.hpp"
#include "native/formulas/projection_backward.hpp"
#include "rendering/kernels/view_colour.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

constexpr int kMaxShColumns = 48;

constexpr int kSlotVectors = (kBaseGradients + kLanes - 1) / kLanes;

// A vector of touched Gaussians on their way out.
struct Group {
  Rows rows{};
  alignas(64) float sums[kLanes][kSlotStride];  // summed slots
};

// Gradients as columns, and those of view-dependent colours as rows, the layout of the array.
struct GroupGradients {
  ParameterGradients parameters;
  Float sh_constant[3];
  alignas(64) float sh[kLanes * kMaxShColumns];
};

SplatGradients splat_gradients(const Group& group) {
  Float s[12];
  const float* slots[kLanes];
  for (int first = 0; first < 12; first += 4) {
    for (int lane = 0; lane < kLanes; ++lane) slots[lane] = group.sums[lane] + first;
    load_four_columns(slots, s + first);
  }
  return {s[0], s[1], s[2], s[3], s[4], s[5], {s[6], s[7], s[8]}, s[9]};
}

// basis[k] times the colour's gradient, as rows.
void sh_rows(const GaussianArrays& arrays, const Float basis[16], const Float colour[3], float* rows) {
  const int columns = 3 * arrays.sh_coefficients;
  for (int k = 0; k < arrays.sh_coefficients; ++k) {
    const Float b = k < arrays.active_sh_coefficients ? basis[k] : Float{};
    for (int channel = 0; channel < 3; ++channel) {
      alignas(64) float values[kLanes];
      store(values, b * colour[channel]);
      for (int lane = 0; lane < kLanes; ++lane) rows[lane * columns + 3 * k + channel] = values[lane];
    }
  }
}

// `sh`: whether gradients of coefficients from degree 1 on are asked for.
void differentiate_group(const Rasterizer& r, const ViewConstants& c, const Group& group, bool sh, GroupGradients& out,
                         double* twist) {
  const GaussianArrays& arrays = r.gaussians;
  const RawGaussian raw = load_gaussians(arrays, group.rows);
  const Projection p = project(c, raw);
  SplatGradients g = splat_gradients(group);
  differentiate_cut_at_black(arrays, c, group.rows, p.position, g.colour);
  Float basis[16], direction_gradient[3];
  differentiate_view_colour(arrays, c, group.rows, p.position, g.colour, basis, direction_gradient);
  out.parameters = differentiate_projection(c, raw, p, g, direction_gradient);
  for (int channel = 0; channel < 3; ++channel) out.sh_constant[channel] = basis[0] * g.colour[channel];
  if (sh) sh_rows(arrays, basis, g.colour, out.sh);
  for (int k = 0; k < 6; ++k) {
    Float in_use = out.parameters.twist[k];
    for (int lane = group.rows.n; lane < kLanes; ++lane) in_use[lane] = 0.0f;
    twist[k] += static_cast<double>(sum(in_use));
  }
}

inline void write_rows(float* array, int width, const Rows& rows, const float* from, int stride) {
  for (int i = 0; i < rows.n; ++i)
    __builtin_memcpy(array + static_cast<std::size_t>(rows.numbers[i]) * width, from + i * stride,
                     sizeof(float) * width);
}

void write_gradients(const Rasterizer& r, const Rows& rows, const GroupGradients& in, const float* features,
                     const GaussianGradients& out) {
  store_rows<3>(in.parameters.mean, out.means, rows);
  store_rows<4>(in.parameters.quaternion, out.quaternions, rows);
  store_rows<3>(in.parameters.log_scale, out.log_scales, rows);
  store_column(in.parameters.opacity_logit, out.opacity_logits, rows);
  const int columns = 3 * r.gaussians.sh_coefficients;
  if (columns == 3) store_rows<3>(in.sh_constant, out.sh, rows);
  else write_rows(out.sh, columns, rows, in.sh, columns);
  if (r.padded_features > 0)
    write_rows(out.features, r.gaussians.feature_channels, rows, features, r.padded_features);
}

// Coefficients that are fitted and not trained have a rate of 0.
bool trains_harmonics(const Rasterizer& r, const AdamArguments& adam) {
  return r.gaussians.sh_coefficients > 1 && adam.schedule[kShRest] != 0;
}

void apply_adam(const Rasterizer& r, const Rows& rows, const GroupGradients& in, const float* features,
                const AdamArguments& adam) {
  AdamRows updated;
  count_updates(adam, rows, updated);
  adam_narrow<3>(adam, adam.means, 3, updated, kMeans, in.parameters.mean);
  adam_narrow<4>(adam, adam.quaternions, 4, updated, kQuaternions, in.parameters.quaternion);
  adam_narrow<3>(adam, adam.log_scales, 3, updated, kLogScales, in.parameters.log_scale);
  adam_single(adam, adam.opacity_logits, updated, kOpacityLogits, in.parameters.opacity_logit);
  const int columns = 3 * r.gaussians.sh_coefficients;
  adam_narrow<3>(adam, adam.sh, columns, updated, kShConstant, in.sh_constant);
  if (trains_harmonics(r, adam)) adam_wide(adam, adam.sh, columns, 3, columns, updated, kShRest, in.sh, columns);
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

// Adds up the slots of one splat to `out`; false if no tile used it. Most splats have up to four slots, in random
// order: so many are looked at without asking, and those that are not its own or not in use count as zeros.
inline bool sum_slots(const Rasterizer& r, const Splat& splat, std::size_t first, float* out) {
  const int pairs = splat.tiles.wide * splat.tiles.high;
  Float total[kSlotVectors] = {};
  std::int32_t touched = 0;
  const auto add = [&](int j, std::int32_t used) {
    const std::int32_t* slot = reinterpret_cast<const std::int32_t*>(r.slots.data() + (first + j) * kSlotStride);
    for (int v = 0; v < kSlotVectors; ++v) total[v] += (Float)(load_int(slot + v * kLanes) & -used);
    touched |= used;
  };
  const std::uint8_t* used = r.slot_used.data() + first;
  for (int j = 0; j < kSlotsAtOnce; ++j) add(j, used[j] & static_cast<std::int32_t>(j < pairs));
  for (int j = kSlotsAtOnce; j < pairs; ++j) add(j, used[j]);
  for (int v = 0; v < kSlotVectors; ++v) store(out + v * kLanes, total[v]);
  return touched != 0;
}

inline void sum_feature_slots(const Rasterizer& r, const Splat& splat, std::size_t first, float* features) {
  const int pairs = splat.tiles.wide * splat.tiles.high, channels = r.padded_features;
  __builtin_memset(features, 0, sizeof(float) * channels);
  for (int j = 0; j < pairs; ++j) {
    if (!r.slot_used[first + j]) continue;
    const float* slot = r.feature_slots.data() + (first + j) * channels;
    for (int q = 0; q < channels; ++q) features[q] += slot[q];
  }
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
  group.rows.count = r.gaussians.count;
  GroupGradients found;
  const bool harmonics = (r.gaussians.sh_coefficients > 1 && gradients.means != nullptr) ||
                         (adam != nullptr && trains_harmonics(r, *adam));
  float* features = scratch.gaussian_features.data();  // [kLanes][padded_features]
  const auto flush = [&] {
    for (int lane = group.rows.n; lane < kLanes; ++lane) {
      group.rows.numbers[lane] = group.rows.numbers[0];
      for (float& value : group.sums[lane]) value = 0.0f;
    }
    differentiate_group(r, c, group, harmonics, found, twist);
    if (adam != nullptr) apply_adam(r, group.rows, found, features, *adam);
    if (gradients.means != nullptr) write_gradients(r, group.rows, found, features, gradients);
    group.rows.n = 0;
  };
  for (int i = 0; i < r.visible[block]; ++i) {
    const Splat& splat = r.splats[begin + i];
    const std::size_t first = r.pairs[block] + splat.first_pair;
    const int n = group.rows.n;
    if (!sum_slots(r, splat, first, group.sums[n])) continue;
    if (r.padded_features > 0) sum_feature_slots(r, splat, first, features + n * r.padded_features);
    gradients.touched[splat.gaussian] = 1;
    if (adam != nullptr) prefetch_adam(r, *adam, splat.gaussian);
    group.rows.numbers[n] = splat.gaussian;
    group.rows.n = n + 1;
    if (n + 1 == kLanes) flush();
  }
  if (group.rows.n > 0) flush();
  for (int k = 0; k < 6; ++k) r.block_twist[6 * block + k] = twist[k];
}

}  // namespace ggslam::GGSLAM_ISA
