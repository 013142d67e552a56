// SPDX-License-Identifier: Apache-2.0
// Symmetric 3x3 matrices packed as xx xy xz yy yz zz: eigenvectors and the regularisation of covariances.
#pragma once
#include <algorithm>
#include <cmath>

namespace ggslam::GGSLAM_ISA {

// Eigenvalues, largest first, and unit eigenvectors (axes[i] belongs to values[i]) by cyclic Jacobi rotations.
static inline void eigen_symmetric3(const float packed[6], float values[3], float axes[3][3]) {
  double a[3][3] = {{packed[0], packed[1], packed[2]}, {packed[1], packed[3], packed[4]}, {packed[2], packed[4], packed[5]}};
  double v[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  const double scale = a[0][0] + a[1][1] + a[2][2];
  for (int sweep = 0; sweep < 8; ++sweep) {
    const double off = a[0][1] * a[0][1] + a[0][2] * a[0][2] + a[1][2] * a[1][2];
    if (off <= 1e-16 * scale * scale) break;
    for (int p = 0; p < 2; ++p)
      for (int q = p + 1; q < 3; ++q) {
        if (a[p][q] == 0) continue;
        const double theta = (a[q][q] - a[p][p]) / (2 * a[p][q]);
        const double t = (theta >= 0 ? 1.0 : -1.0) / (std::fabs(theta) + std::sqrt(theta * theta + 1));
        const double c = 1 / std::sqrt(t * t + 1), s = t * c;
        const int r = 3 - p - q;
        const double apq = a[p][q], arp = a[r][p], arq = a[r][q];
        a[p][p] -= t * apq;
        a[q][q] += t * apq;
        a[p][q] = a[q][p] = 0;
        a[r][p] = a[p][r] = c * arp - s * arq;
        a[r][q] = a[q][r] = s * arp + c * arq;
        for (int i = 0; i < 3; ++i) {
          const double vip = v[i][p], viq = v[i][q];
          v[i][p] = c * vip - s * viq;
          v[i][q] = s * vip + c * viq;
        }
      }
  }
  int order[3] = {0, 1, 2};
  if (a[order[0]][order[0]] < a[order[1]][order[1]]) std::swap(order[0], order[1]);
  if (a[order[1]][order[1]] < a[order[2]][order[2]]) std::swap(order[1], order[2]);
  if (a[order[0]][order[0]] < a[order[1]][order[1]]) std::swap(order[0], order[1]);
  for (int i = 0; i < 3; ++i) {
    values[i] = static_cast<float>(a[order[i]][order[i]]);
    for (int j = 0; j < 3; ++j) axes[i][j] = static_cast<float>(v[j][order[i]]);
  }
}

// Regularised eigenvalues S' = S / median(S) (GS-ICP, equation 1; S are variances, largest first) with bounds that
// keep every shape usable: the median is at least the largest / max_elongation, so that a needle does not become
// infinitely long, and the smallest lies in [min_thickness, max_thickness], so that a plane stays a plane however
// thin it is measured. Result: (1 .. max_elongation, at most 1, thickness).
static inline void regularized_axes(const float values[3], float min_thickness, float max_thickness,
                                    float max_elongation, float result[3]) {
  const float largest = std::max(values[0], 1e-20f);
  const float median = std::max(values[1], largest / max_elongation);
  result[0] = largest / median;
  result[1] = 1.0f;
  result[2] = std::min(std::max(values[2] / median, min_thickness), max_thickness);
}

// axes^T diag(values) axes, packed.
static inline void compose_symmetric3(const float values[3], const float axes[3][3], float packed[6]) {
  int k = 0;
  for (int i = 0; i < 3; ++i)
    for (int j = i; j < 3; ++j, ++k)
      packed[k] = values[0] * axes[0][i] * axes[0][j] + values[1] * axes[1][i] * axes[1][j] +
                  values[2] * axes[2][i] * axes[2][j];
}

}  // namespace ggslam::GGSLAM_ISA
