// SPDX-License-Identifier: Apache-2.0
// Symmetric 3x3 matrices packed as xx xy xz yy yz zz: eigenvectors and the regularisation of covariances. All indices are
// known to the compiler, so that everything stays in registers. Compiled for CPU and GPU: see formulas.hpp.
#pragma once
#include <cmath>

#include "native/formulas/formulas.hpp"

namespace GGSLAM_FORMULAS {

// One Jacobi rotation of a[kP][kQ] to zero; v gathers the rotations.
template <int kP, int kQ>
GGSLAM_FORMULA void jacobi_rotation(double (&a)[3][3], double (&v)[3][3]) {
  constexpr int kR = 3 - kP - kQ;
  if (a[kP][kQ] == 0) return;
  const double theta = (a[kQ][kQ] - a[kP][kP]) / (2 * a[kP][kQ]);
  const double t = (theta >= 0 ? 1.0 : -1.0) / (std::fabs(theta) + std::sqrt(theta * theta + 1));
  const double c = 1 / std::sqrt(t * t + 1), s = t * c;
  const double apq = a[kP][kQ], arp = a[kR][kP], arq = a[kR][kQ];
  a[kP][kP] -= t * apq;
  a[kQ][kQ] += t * apq;
  a[kP][kQ] = a[kQ][kP] = 0;
  a[kR][kP] = a[kP][kR] = c * arp - s * arq;
  a[kR][kQ] = a[kQ][kR] = s * arp + c * arq;
  for (int i = 0; i < 3; ++i) {
    const double vip = v[i][kP], viq = v[i][kQ];
    v[i][kP] = c * vip - s * viq;
    v[i][kQ] = s * vip + c * viq;
  }
}

// Exchanges eigenvalues kI and kJ and their vectors if the second is the larger.
template <int kI, int kJ>
GGSLAM_FORMULA void order_pair(double (&values)[3], double (&v)[3][3]) {
  if (!(values[kI] < values[kJ])) return;
  const double value = values[kI];
  values[kI] = values[kJ], values[kJ] = value;
  for (int i = 0; i < 3; ++i) {
    const double entry = v[i][kI];
    v[i][kI] = v[i][kJ], v[i][kJ] = entry;
  }
}

// Eigenvalues, largest first, and unit eigenvectors (axes[i] belongs to values[i]) by cyclic Jacobi rotations, until the
// squares off the diagonal are `rest` of the squared trace.
template <class Number>
GGSLAM_FORMULA void eigen_symmetric3(const Number (&packed)[6], double rest, Number (&values)[3], Number (&axes)[3][3]) {
  double a[3][3] = {{packed[0], packed[1], packed[2]}, {packed[1], packed[3], packed[4]}, {packed[2], packed[4], packed[5]}};
  double v[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  const double scale = a[0][0] + a[1][1] + a[2][2];
  for (int sweep = 0; sweep < 8; ++sweep) {
    const double off = a[0][1] * a[0][1] + a[0][2] * a[0][2] + a[1][2] * a[1][2];
    if (off <= rest * scale * scale) break;
    jacobi_rotation<0, 1>(a, v);
    jacobi_rotation<0, 2>(a, v);
    jacobi_rotation<1, 2>(a, v);
  }
  double found[3] = {a[0][0], a[1][1], a[2][2]};
  order_pair<0, 1>(found, v);
  order_pair<1, 2>(found, v);
  order_pair<0, 1>(found, v);
  for (int i = 0; i < 3; ++i) {
    values[i] = static_cast<Number>(found[i]);
    for (int j = 0; j < 3; ++j) axes[i][j] = static_cast<Number>(v[j][i]);
  }
}

GGSLAM_FORMULA void eigen_symmetric3(const float (&packed)[6], float (&values)[3], float (&axes)[3][3]) {
  eigen_symmetric3(packed, 1e-16, values, axes);
}

// Regularised eigenvalues S' = S / median(S) (GS-ICP, equation 1; S are variances, largest first) with bounds that
// keep every shape usable: the median is at least the largest / max_elongation, so that a needle does not become
// infinitely long, and the smallest lies in [min_thickness, max_thickness], so that a plane stays a plane however
// thin it is measured. Result: (1 .. max_elongation, at most 1, thickness).
GGSLAM_FORMULA void regularized_axes(const float (&values)[3], float min_thickness, float max_thickness,
                                        float max_elongation, float (&result)[3]) {
  const float largest = larger_of(values[0], 1e-20f);
  const float median = larger_of(values[1], largest / max_elongation);
  result[0] = largest / median;
  result[1] = 1.0f;
  result[2] = smaller_of(larger_of(values[2] / median, min_thickness), max_thickness);
}

// axes^T diag(values) axes, packed.
GGSLAM_FORMULA void compose_symmetric3(const float (&values)[3], const float (&axes)[3][3], float* packed) {
  int k = 0;
  for (int i = 0; i < 3; ++i)
    for (int j = i; j < 3; ++j, ++k)
      packed[k] = values[0] * axes[0][i] * axes[0][j] + values[1] * axes[1][i] * axes[1][j] +
                  values[2] * axes[2][i] * axes[2][j];
}

}  // namespace GGSLAM_FORMULAS
