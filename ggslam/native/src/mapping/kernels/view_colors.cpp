// SPDX-License-Identifier: Apache-2.0
// Directions, harmonics and weights of a vector of Gaussians at once; each one's equations lie together, so these are
// added to Gaussian by Gaussian.
#include "mapping/view_colors.hpp"

#include "rendering/kernels/numbers.hpp"
#include "native/formulas/spherical_harmonics.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

// Of a vector of Gaussians: what their equations get from a view.
struct Shares {
  alignas(64) float basis[16][kLanes];
  alignas(64) float weight[kLanes];        // of the equation; 0: the view says nothing
  alignas(64) float residual[3][kLanes];
};

inline Float channel(const float* gradients, const ViewColorsOfView& job, const Rows& rows, int c) {
  Float v;
  for (int lane = 0; lane < kLanes; ++lane) v[lane] = gradients[static_cast<std::int64_t>(rows.numbers[lane]) * job.stride + c];
  return v;
}

// Gradients are of the constant coefficient: colours times kSh0.
void find_shares(const ViewColorsOfView& job, const Rows& rows, Shares& out) {
  Float d[3], residual[3];
  load_rows<3>(job.means, rows, d);
  for (int i = 0; i < 3; ++i) d[i] -= job.centre[i];
  const Float far = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
  const Float inverse = 1.0f / square_root(maximum(far, broadcast(1e-12f)));
  Float basis[16];
  sh_basis(job.count + 1, d[0] * inverse, d[1] * inverse, d[2] * inverse, basis);
  const Float seen = channel(job.weights, job, rows, 0) * (1.0f / kSh0);
  const Float per_pixel = 1.0f / (kSh0 * maximum(seen, broadcast(job.least_weight)));
  Float size2{};
  for (int c = 0; c < 3; ++c) {
    residual[c] = channel(job.residuals, job, rows, c) * per_pixel;
    size2 += residual[c] * residual[c];
    store(out.residual[c], residual[c]);
  }
  const Float size = square_root(size2 * (1.0f / 3.0f));
  const Float trust = minimum(broadcast(1.0f), job.usual_residual / maximum(size, broadcast(1e-9f)));
  const Float weight = minimum(seen, broadcast(job.most_weight)) * trust;
  store(out.weight, zero_unless(greater(seen, broadcast(job.least_weight)), weight));
  for (int k = 1; k <= job.count; ++k) store(out.basis[k], basis[k]);
}

}  // namespace

void view_colors_add(const ViewColorsOfView& job, std::int64_t begin, std::int64_t end) {
  const int n = job.count, floats = view_color_floats(n);
  Shares shares;
  Rows rows;
  rows.count = job.gaussians;
  for (std::int64_t i = begin; i < end; i += kLanes) {
    rows.n = static_cast<int>(end - i < kLanes ? end - i : kLanes);
    bool any = false;
    for (int lane = 0; lane < kLanes; ++lane) {
      rows.numbers[lane] = static_cast<std::int32_t>(lane < rows.n ? i + lane : i);
      any = any || job.weights[static_cast<std::int64_t>(rows.numbers[lane]) * job.stride] != 0;
    }
    if (!any) continue;
    find_shares(job, rows, shares);
    for (int lane = 0; lane < rows.n; ++lane) {
      const float weight = shares.weight[lane];
      if (weight == 0) continue;
      float* equation = job.equations + (i + lane) * floats;
      float weighted[kMostViewColors], basis[kMostViewColors];
      for (int k = 0; k < n; ++k) basis[k] = shares.basis[k + 1][lane], weighted[k] = weight * basis[k];
      for (int k = 0; k < n; ++k)
        for (int j = 0; j <= k; ++j) *equation++ += weighted[k] * basis[j];
      for (int k = 0; k < n; ++k)
        for (int c = 0; c < 3; ++c) *equation++ += weighted[k] * shares.residual[c][lane];
    }
  }
}

}  // namespace ggslam::GGSLAM_ISA
