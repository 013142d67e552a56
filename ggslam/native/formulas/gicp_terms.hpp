// SPDX-License-Identifier: Apache-2.0
// What a matched pair of points contributes to Generalised ICP (Segal et al., RSS 2009). Compiled for CPU and GPU: see
// formulas.hpp.
#pragma once
#include "native/formulas/formulas.hpp"

namespace GGSLAM_FORMULAS {

// (target + R source R^T)^-1, all packed.
GGSLAM_FORMULA void match_precision(const float* target, const float* source, const float* r, float inverse[6]) {
  const float s[3][3] = {{source[0], source[1], source[2]}, {source[1], source[3], source[4]}, {source[2], source[4], source[5]}};
  float rs[3][3], a[6];
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) rs[i][j] = r[3 * i] * s[0][j] + r[3 * i + 1] * s[1][j] + r[3 * i + 2] * s[2][j];
  int k = 0;
  for (int i = 0; i < 3; ++i)
    for (int j = i; j < 3; ++j, ++k)
      a[k] = target[k] + rs[i][0] * r[3 * j] + rs[i][1] * r[3 * j + 1] + rs[i][2] * r[3 * j + 2];
  inverse[0] = a[3] * a[5] - a[4] * a[4];
  inverse[1] = a[2] * a[4] - a[1] * a[5];
  inverse[2] = a[1] * a[4] - a[2] * a[3];
  inverse[3] = a[0] * a[5] - a[2] * a[2];
  inverse[4] = a[1] * a[2] - a[0] * a[4];
  inverse[5] = a[0] * a[3] - a[1] * a[1];
  const float f = 1 / (a[0] * inverse[0] + a[1] * inverse[1] + a[2] * inverse[2]);
  for (int i = 0; i < 6; ++i) inverse[i] *= f;
}

// Adds the upper triangle of J^T M J and J^T M d for J = [I | -[q]x], q = p - c.
GGSLAM_FORMULA void add_normal_equations(const float m[6], const float q[3], const float d[3], float h[21], float b[6]) {
  const float full[3][3] = {{m[0], m[1], m[2]}, {m[1], m[3], m[4]}, {m[2], m[4], m[5]}};
  const float x = q[0], y = q[1], z = q[2];
  float mj[3][3];  // M (-[q]x); the columns of -[q]x are (0, -z, y), (z, 0, -x), (-y, x, 0)
  for (int i = 0; i < 3; ++i) {
    mj[i][0] = full[i][2] * y - full[i][1] * z;
    mj[i][1] = full[i][0] * z - full[i][2] * x;
    mj[i][2] = full[i][1] * x - full[i][0] * y;
  }
  h[0] += m[0], h[1] += m[1], h[2] += m[2], h[6] += m[3], h[7] += m[4], h[11] += m[5];
  h[3] += mj[0][0], h[4] += mj[0][1], h[5] += mj[0][2];
  h[8] += mj[1][0], h[9] += mj[1][1], h[10] += mj[1][2];
  h[12] += mj[2][0], h[13] += mj[2][1], h[14] += mj[2][2];
  h[15] += y * mj[2][0] - z * mj[1][0];
  h[16] += y * mj[2][1] - z * mj[1][1];
  h[17] += y * mj[2][2] - z * mj[1][2];
  h[18] += z * mj[0][1] - x * mj[2][1];
  h[19] += z * mj[0][2] - x * mj[2][2];
  h[20] += x * mj[1][2] - y * mj[0][2];
  float md[3];
  for (int i = 0; i < 3; ++i) md[i] = full[i][0] * d[0] + full[i][1] * d[1] + full[i][2] * d[2];
  for (int i = 0; i < 3; ++i) b[i] += md[i];
  b[3] += y * md[2] - z * md[1];
  b[4] += z * md[0] - x * md[2];
  b[5] += x * md[1] - y * md[0];
}

}  // namespace GGSLAM_FORMULAS
