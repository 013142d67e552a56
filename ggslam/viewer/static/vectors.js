// SPDX-License-Identifier: Apache-2.0
// Vectors as arrays of three numbers, rigid transforms as arrays of 16 by rows.

const add = (a, b, f = 1) => a.map((value, i) => value + f * b[i]);
const minus = (a, b) => a.map((value, i) => value - b[i]);
const times = (a, f) => a.map((value) => value * f);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const length = (a) => Math.hypot(a[0], a[1], a[2]);
const unit = (a) => {
  const l = length(a) || 1;
  return a.map((value) => value / l);
};
const between = (a, b, t) => a.map((value, i) => value + t * (b[i] - value));
const turned = (a, axis, angle) => {
  const c = Math.cos(angle),
    s = Math.sin(angle),
    k = cross(axis, a),
    d = dot(axis, a) * (1 - c);
  return a.map((value, i) => value * c + k[i] * s + axis[i] * d);
};
const clamp = (value, low, high) => Math.max(low, Math.min(high, value));

// Upright axes of a world: two level ones and up.
function uprightAxes(up) {
  const near = Math.abs(up[0]) > 0.9 ? [0, 1, 0] : [1, 0, 0],
    level = unit(add(near, up, -dot(near, up)));
  return [level, cross(up, level), up];
}

// A rigid transform: a turn by an angle about an axis through a center, then a shift.
function motionOf(center, axis, angle, shift) {
  const columns = [
      [1, 0, 0],
      [0, 1, 0],
      [0, 0, 1],
    ].map((e) => turned(e, axis, angle)),
    moved = [0, 1, 2].map((r) => dot([columns[0][r], columns[1][r], columns[2][r]], center));
  const t = add(minus(center, moved), shift);
  return [0, 1, 2].flatMap((r) => [columns[0][r], columns[1][r], columns[2][r], t[r]]).concat(0, 0, 0, 1);
}

const transposed = (T) => T.map((_, k) => T[4 * (k % 4) + Math.floor(k / 4)]);
const movedBy = (T, p) =>
  [0, 1, 2].map((r) => T[4 * r] * p[0] + T[4 * r + 1] * p[1] + T[4 * r + 2] * p[2] + T[4 * r + 3]);

// The twelve edges of a box {center, axes (rows), size} as segments.
function boxSegments({ center, axes, size }) {
  const corner = (bits) => axes.reduce((p, axis, k) => add(p, axis, ((bits >> k) & 1 ? 0.5 : -0.5) * size[k]), center);
  const pairs = [];
  for (let a = 0; a < 8; a++)
    for (let k = 0; k < 3; k++) if (!((a >> k) & 1)) pairs.push(corner(a), corner(a | (1 << k)));
  return Float32Array.from(pairs.flat());
}

// Edges of the pyramid that a camera sees, `depth` metres deep. T: T_world_camera by rows.
function frustumSegments(T, { width, height, fx, fy }, depth) {
  const w = (width / 2 / fx) * depth,
    h = (height / 2 / fy) * depth;
  const tip = movedBy(T, [0, 0, 0]),
    far = [
      [-w, -h],
      [w, -h],
      [w, h],
      [-w, h],
    ].map(([x, y]) => movedBy(T, [x, y, depth]));
  return Float32Array.from(far.flatMap((p, i) => [tip, p, p, far[(i + 1) % 4]]).flat());
}

function metres(value) {
  return Math.abs(value) < 1 ? `${(100 * value).toFixed(1)} cm` : `${value.toFixed(3)} m`;
}
