// SPDX-License-Identifier: Apache-2.0
// Direct image alignment: grey values of a frame's points against a reference image.
//
// A point p of the frame falls on pixel u(p) of the reference; the residual is I_reference(u(p)) - (gain I_frame + bias).
// Its derivative by the twist about the frame's camera centre is the chain of the image gradient, the pinhole
// projection and the motion of the point in the reference camera.
#include <algorithm>
#include <cmath>

#include "tracking/tracking_types.hpp"

namespace ggslam::GGSLAM_ISA {
namespace {

struct Sample {
  float grey, du, dv, depth;
};

// Bilinear sample of the four channels; false outside the image or where depth is missing.
bool sample(const PhotometricReferenceView& r, float u, float v, Sample* out) {
  if (!(u >= 0 && v >= 0 && u < r.width - 1 && v < r.height - 1)) return false;
  const int x = static_cast<int>(u), y = static_cast<int>(v);
  const float fx = u - x, fy = v - y;
  const float* a = r.pixels + 4 * (static_cast<std::size_t>(y) * r.width + x);
  const float* b = a + 4 * r.width;
  float value[4];
  for (int c = 0; c < 4; ++c) value[c] = (1 - fy) * ((1 - fx) * a[c] + fx * a[4 + c]) + fy * ((1 - fx) * b[c] + fx * b[4 + c]);
  // Depth of the nearest pixel: the mean across an edge belongs to neither surface.
  const float nearest = (fy < 0.5f ? a : b)[(fx < 0.5f ? 0 : 4) + 3];
  *out = {value[0], value[1], value[2], nearest};
  return true;
}

}  // namespace

void photometric_block(const PhotometricArgs& args, std::size_t begin, std::size_t end, PhotometricSums* sums) {
  const PhotometricReferenceView& ref = args.reference;
  float h[36] = {0}, b[8] = {0}, cost = 0, absolute = 0;
  int count = 0;
  for (std::size_t i = begin; i < end; ++i) {
    const float* p = args.points.points + 3 * i;
    float q[3], w[3], x[3];
    for (int a = 0; a < 3; ++a) q[a] = args.rotation[3 * a] * p[0] + args.rotation[3 * a + 1] * p[1] + args.rotation[3 * a + 2] * p[2];
    for (int a = 0; a < 3; ++a) w[a] = q[a] + args.translation[a];
    for (int a = 0; a < 3; ++a)
      x[a] = ref.rotation[3 * a] * w[0] + ref.rotation[3 * a + 1] * w[1] + ref.rotation[3 * a + 2] * w[2] + ref.translation[a];
    if (x[2] < 0.05f) continue;
    const float inverse_z = 1 / x[2];
    Sample at;
    if (!sample(ref, ref.fx * x[0] * inverse_z + ref.cx, ref.fy * x[1] * inverse_z + ref.cy, &at)) continue;
    if (at.depth > 0 && std::fabs(at.depth - x[2]) > args.depth_tolerance * x[2]) continue;  // occluded or disoccluded
    const float intensity = args.points.intensity[i];
    const float residual = at.grey - (args.gain * intensity + args.bias);
    const float size = std::fabs(residual);
    const float weight = size <= args.huber ? 1 : args.huber / size;
    cost += size <= args.huber ? residual * residual : args.huber * (2 * size - args.huber);
    absolute += size;
    ++count;
    // d grey / d x in the reference camera, turned to world axes.
    const float gx = at.du * ref.fx * inverse_z, gy = at.dv * ref.fy * inverse_z;
    const float g[3] = {gx, gy, -(gx * x[0] + gy * x[1]) * inverse_z};
    float gw[3];
    for (int a = 0; a < 3; ++a) gw[a] = ref.rotation[a] * g[0] + ref.rotation[3 + a] * g[1] + ref.rotation[6 + a] * g[2];
    const float j[8] = {gw[0], gw[1], gw[2], q[1] * gw[2] - q[2] * gw[1], q[2] * gw[0] - q[0] * gw[2],
                        q[0] * gw[1] - q[1] * gw[0], -intensity, -1};
    int k = 0;
    for (int a = 0; a < 8; ++a) {
      const float wj = weight * j[a];
      b[a] -= wj * residual;
      for (int c = a; c < 8; ++c, ++k) h[k] += wj * j[c];
    }
  }
  for (int k = 0; k < 36; ++k) sums->h[k] = h[k];
  for (int k = 0; k < 8; ++k) sums->b[k] = b[k];
  sums->cost = cost;
  sums->count = count;
  sums->absolute = absolute;
}

}  // namespace ggslam::GGSLAM_ISA
