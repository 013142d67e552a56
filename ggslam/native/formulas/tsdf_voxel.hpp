// SPDX-License-Identifier: Apache-2.0
// How a view changes a voxel. Stated for Floats, Ints and Masks, which are vectors in the core (common/kernels/simd.hpp and
// volumes/kernels/voxel_vectors.hpp) and one of each in a kernel (volumes/numbers.cuh); those files define their functions.
//
// A View has: depth (with room to read a row and a pixel past the end) and eroded (null: no clearing), width, height, fx,
// fy, cx, cy; truncation, voxel, edge, clearing; max_depth: depth beyond it tells of free space alone; weight_scale: 65535
// / largest weight; max_free_weight, in 65535ths of the largest.
#pragma once
#include "native/formulas/formulas.hpp"
#include "native/formulas/tsdf_rules.hpp"

namespace GGSLAM_FORMULAS {

// What is known of voxels, step by step.
struct Sighted {
  Float z, inverse, u, v;
  Float distance;  // to the surface along the optical axis, positive in front; kNothing: unknown
  Float share;     // of the new measurement in the voxel's mean; 0 beyond the truncation
  Int pixel;       // the nearest; 0 outside the image
};

constexpr float kNothing = -1e30f;

GGSLAM_FORMULA Float rounded(Float v) { return to_float(truncate(v + 0.5f)); }

// Distance within which interpolation, which moves the depth by less than `edge` or 2 %, can matter.
template <class View>
GGSLAM_FORMULA Float reach(const View& t, Float depth) {
  return t.truncation + maximum(broadcast(t.edge), depth * 0.02f);
}

// Projects voxels with centres p (camera frame) and compares them with the nearest pixel; `near`: within reach of it.
template <class View>
GGSLAM_FORMULA Sighted compared(const View& t, const Float (&p)[3], Mask& seen, Mask& near) {
  const Float least_z = broadcast(volumes::kNear), left = broadcast(-0.5f), nothing = broadcast(kNothing);
  const Float right = broadcast(t.width - 0.5f), bottom = broadcast(t.height - 0.5f);
  const Float max_depth = broadcast(t.max_depth);
  const Float inverse = 1.0f / maximum(p[2], least_z);
  const Float u = t.fx * (p[0] * inverse) + t.cx, v = t.fy * (p[1] * inverse) + t.cy;
  const Mask inside = both(both(greater(p[2], least_z), both(greater_equal(u, left), greater(right, u))),
                           both(greater_equal(v, left), greater(bottom, v)));
  const Int pixel = truncate(zero_unless(inside, v + 0.5f)) * t.width + truncate(zero_unless(inside, u + 0.5f));
  const Float depth = gather(t.depth, pixel);
  // Depth beyond the range is no surface's: it tells of what lies before it alone.
  const Float gap = depth - p[2], least = select(greater(depth, max_depth), Float{}, nothing);
  const Mask told = both(both(inside, greater(depth, Float{})), greater_equal(gap, least));
  const Float distance = select(told, gap, nothing);
  const Float band = reach(t, depth);
  seen = greater_equal(distance, -band);
  near = both(seen, greater(band, distance));
  return {p[2], inverse, u, v, distance, Float{}, pixel};
}

// Takes the depth between the four pixels around a voxel, where they are all there, in range, and differ little.
template <class View>
GGSLAM_FORMULA void interpolate(const View& t, Sighted& g) {
  const Float u = g.u, v = g.v;
  const Mask inside =
      both(both(greater_equal(u, Float{}), greater(broadcast(static_cast<float>(t.width - 1)), u)),
           both(greater_equal(v, Float{}), greater(broadcast(static_cast<float>(t.height - 1)), v)));
  const Mask wanted = both(inside, greater(g.distance, broadcast(kNothing)));
  const Int u0 = truncate(zero_unless(wanted, u)), v0 = truncate(zero_unless(wanted, v));
  const Int at = v0 * t.width + u0;
  Float a, b, c, d;
  gather_pairs(t.depth, at, a, b), gather_pairs(t.depth + t.width, at, c, d);
  const Float low = minimum(minimum(a, b), minimum(c, d)), high = maximum(maximum(a, b), maximum(c, d));
  const Float allowed = maximum(broadcast(t.edge), low * 0.02f);
  const Mask within = both(greater(low, Float{}), greater_equal(broadcast(t.max_depth), high));
  const Mask smooth = both(wanted, both(within, greater_equal(allowed, high - low)));
  const Float x = u - to_float(u0), y = v - to_float(v0);
  const Float top = a + x * (b - a), bottom = c + x * (d - c);
  g.distance = select(smooth, top + y * (bottom - top) - g.z, g.distance);
}

// Clears voxels that the view surely looks through, with all pixels around and by more than the depth is wrong: they lose a
// share of their weight. At edges and by less, poses and depth may be at fault as well: the measurement counts little.
template <class View>
GGSLAM_FORMULA void clear_passed(const View& t, const Sighted& g, Mask through, Float& weight, Float& measured) {
  const Float needed = g.z * (1 + volumes::kDoubt) + t.truncation;
  const Mask sure = both(through, greater_equal(gather(t.eroded, g.pixel), needed));
  const Float little = minimum(measured, maximum(broadcast(1.0f), rounded(weight * volumes::kDoubtfulShare)));
  measured = select(neither_of(through, sure), little, measured);
  weight = select(sure, rounded(weight * (1 - t.clearing)), weight);
}

// Value and weight of voxels after a view.
struct Averaged {
  Int value, weight;
  Mask changed, band;  // band: within the truncation of a surface
};

// Averages values and weights; sets the group's share.
template <class View>
GGSLAM_FORMULA Averaged averaged(const View& t, Sighted& g, Int old_value, Int old_weight) {
  const Float truncation = broadcast(t.truncation), one = broadcast(1.0f), full = broadcast(volumes::kFreeValue);
  const Float distance = g.distance;
  const Float drop = minimum((distance + t.truncation) * (1.0f / (t.truncation - t.voxel)), one);
  Float measured = minimum(rounded(t.weight_scale * g.inverse * g.inverse * drop), broadcast(volumes::kFullWeight));
  const Float value = to_float(old_value);
  Float weight = to_float(old_weight);
  // Depth beyond the range makes known what is free up to the range. What a surface in range left nearer to it, or behind
  // the range, goes with that surface.
  const Mask in_range = greater_equal(broadcast(t.max_depth * volumes::kRangeSlack), distance + g.z);
  const Mask before = both(greater_equal(distance, truncation), greater_equal(broadcast(t.max_depth), g.z));
  const Mask told = either(greater(weight, Float{}), either(in_range, before));
  const Mask valid = both(told, both(greater_equal(distance, -truncation), greater_equal(measured, one)));

  const Mask behind = both(valid, greater_equal(distance, truncation));  // the surface is: the voxel is free
  const Float scaled = (volumes::kFreeValue / t.truncation) * distance;
  const Mask surface = both(greater(weight, Float{}), greater(broadcast(volumes::kFreeFrom), value));
  const Mask through = both(both(behind, surface), greater(scaled - value, full * volumes::kSurprise));
  if (t.eroded != nullptr && any(through)) clear_passed(t, g, through, weight, measured);

  const Float total = weight + measured, share = measured / total;
  Float mean = value + share * (minimum(scaled, full) - value);
  mean = select(both(behind, greater_equal(mean, broadcast(volumes::kFreeFrom))), full, mean);
  const Float most = select(greater_equal(mean, full), broadcast(t.max_free_weight), broadcast(volumes::kFullWeight));
  // Elsewhere the mean may be anything, infinite and NaN included.
  const Int new_value = truncate(select(valid, mean, value) + 32768.5f) - 32768;
  // A weight above the limit of free space shrinks by no more than what was measured.
  const Float grown = select(valid, minimum(total, maximum(most, weight - measured)), to_float(old_weight));

  const Mask unseen = greater(one, to_float(old_weight));
  const Float moved = absolute(to_float(new_value - old_value));
  const Mask band = neither_of(valid, behind);
  g.share = zero_unless(band, share);
  return {new_value, truncate(grown), both(valid, either(unseen, greater(moved, Float{}))), band};
}

// How much of a new colour a voxel takes; black stands for one that has no colour yet.
GGSLAM_FORMULA Float color_share(Mask bare, Float share) {
  const Float wanted = select(bare, broadcast(1.0f), maximum(share, broadcast(volumes::kColorShare)));
  return zero_unless(greater(share, Float{}), wanted);
}

GGSLAM_FORMULA Int blended(Int old, Int now, Float share) {
  const Float from = to_float(old);
  return truncate(from + share * (to_float(now) - from) + 0.5f);
}

// A voxel's vote at the surface for a label that is not 0; whether that changed its label.
GGSLAM_FORMULA bool vote_for(std::uint16_t seen, std::uint16_t& label, std::uint8_t& votes) {
  if (seen == label) {
    if (votes < 255) ++votes;
  } else if (votes == 0) {
    label = seen, votes = 1;
    return true;
  } else {
    --votes;
  }
  return false;
}

}  // namespace GGSLAM_FORMULAS
