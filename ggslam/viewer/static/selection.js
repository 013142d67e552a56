// SPDX-License-Identifier: Apache-2.0
// Which splats a selection holds. ggslam/objects/selection.py states the same rules and decides for a served map.

const SEEN_SHARE = 0.05,
  SEEN_M = 0.03; // a splat is seen up to this much behind the surface there

// steps: [{mode, shape}]; splats: {count, centers, ids}; depthOf(shape): Float32Array of the mask's size, or null.
// Gives Uint8Array [n] of 0 and 1.
function selectedSplats(steps, splats, depthOf = () => null) {
  let selected = new Uint8Array(splats.count);
  for (const { mode, shape } of steps) {
    const found = shapeTest(shape, depthOf(shape)),
      hidden = new Set(shape.hidden || []),
      { centers, ids } = splats,
      next = mode === "set" ? new Uint8Array(splats.count) : selected;
    for (let i = 0; i < splats.count; i++) {
      const inside = !hidden.has(ids[i]) && found(centers[3 * i], centers[3 * i + 1], centers[3 * i + 2], ids[i]);
      if (mode === "set" || mode === "add") {
        if (inside) next[i] = 1;
      } else if (mode === "remove") {
        if (inside) next[i] = 0;
      } else if (mode === "invert") {
        if (inside) next[i] = 1 - next[i];
      } else if (!inside) next[i] = 0;
    }
    selected = next;
  }
  return selected;
}

function shapeTest(shape, depth) {
  if (shape.kind === "all") return () => true;
  if (shape.kind === "objects") {
    const ids = new Set(shape.ids);
    return (x, y, z, id) => ids.has(id);
  }
  if (shape.kind === "sphere") {
    const [a, b, c] = shape.center,
      limit = shape.radius ** 2;
    return (x, y, z) => (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 <= limit;
  }
  if (shape.kind === "box") {
    const { center, axes, size } = shape;
    return (x, y, z) =>
      axes.every(
        (axis, k) =>
          Math.abs(axis[0] * (x - center[0]) + axis[1] * (y - center[1]) + axis[2] * (z - center[2])) <= size[k] / 2,
      );
  }
  return screenTest(shape, depth);
}

function screenTest({ T_camera_world: T, width, height, focal, near, mask, seen_only }, depth) {
  const set = maskOf(mask),
    { width: w, height: h } = mask,
    least = Math.max(near, 1e-9);
  return (x, y, z) => {
    const depthHere = T[8] * x + T[9] * y + T[10] * z + T[11];
    if (depthHere <= least) return false;
    const column = Math.floor(
      ((((T[0] * x + T[1] * y + T[2] * z + T[3]) / depthHere) * focal + width / 2) * w) / width,
    );
    const row = Math.floor(((((T[4] * x + T[5] * y + T[6] * z + T[7]) / depthHere) * focal + height / 2) * h) / height);
    if (column < 0 || column >= w || row < 0 || row >= h || !set[row * w + column]) return false;
    if (!seen_only || !depth) return true;
    const surface = depth[row * w + column];
    return surface > 0 && depthHere <= (1 + SEEN_SHARE) * surface + SEEN_M;
  };
}

// A mask {width, height, runs: [so many not set, so many set, ...]} as Uint8Array.
function maskOf({ width, height, runs }) {
  const set = new Uint8Array(width * height);
  let place = 0;
  runs.forEach((run, k) => {
    if (k % 2) set.fill(1, place, place + run);
    place += run;
  });
  return set;
}

// The other way: of RGBA pixels, those that are not transparent.
function runsOf(rgba) {
  const runs = [0];
  let value = false;
  for (let i = 3; i < rgba.length; i += 4) {
    if (rgba[i] > 127 !== value) {
      value = !value;
      runs.push(0);
    }
    runs[runs.length - 1]++;
  }
  return runs;
}

// Bits as the server gives them, base64, lowest first, to Uint8Array [n].
function bitsOf(text, n) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)),
    found = new Uint8Array(n);
  for (let i = 0; i < n; i++) found[i] = (bytes[i >> 3] >> (i & 7)) & 1;
  return found;
}
