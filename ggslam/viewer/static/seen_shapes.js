// SPDX-License-Identifier: Apache-2.0
// What a splat looks like from where no view of the recording saw it (ggslam/viewer/viewed_sides.py): from behind it
// fades, from aside it is no longer than it is wide, and from nearer by it does not cover the screen. From the views
// that saw it, it is as it was trained. Runs in workers; webgl_programs.js says the same.

const SEEN_RULES = Object.freeze({
  nearest: 0.05,
  step: 1.03, // metres that byte 1 of a distance means, and the factor of each further one
  fadeFrom: 80,
  fadeBeside: 10,
  fadeOver: 25, // degrees: fades from 80, or 10 beside the cone, over 25 more
  shortenBeside: 10,
  shortenOver: 30, // degrees beside the cone from which on, and over which, a splat is shortened
  size: 0.3,
  growth: 1.5, // largest share of its distance that a splat's size has, or so many times what was seen
});

class SeenShapes {
  // seen: Uint8 [4n]; covariances: Float32 [6n].
  constructor(seen, covariances) {
    this.seen = seen;
    this.covariances = covariances;
    this.shape = new Float64Array(6);
    const R = SEEN_RULES,
      cosine = (degrees) => Math.cos((Math.min(180, degrees) * Math.PI) / 180);
    const table = (value) => Float64Array.from({ length: 256 }, (_, byte) => value(byte));
    const cone = (byte) => (byte * 180) / 255,
      fade = (byte) => Math.max(R.fadeFrom, cone(byte) + R.fadeBeside);
    this.fadeFrom = table((byte) => cosine(fade(byte)));
    this.fadeTo = table((byte) => cosine(fade(byte) + R.fadeOver));
    this.shortFrom = table((byte) => cosine(cone(byte) + R.shortenBeside));
    this.shortTo = table((byte) => cosine(cone(byte) + R.shortenBeside + R.shortenOver));
    this.distances = table((byte) => (byte ? R.nearest * R.step ** (byte - 1) : Infinity));
    this.directions = octahedralDirections(seen);
  }

  // Share of its opacity that splat i of a size has if the eye is (x, y, z) from it; `shape` becomes its covariance.
  look(i, x, y, z, size) {
    const R = SEEN_RULES,
      distance = Math.sqrt(x * x + y * y + z * z),
      byte = this.seen[4 * i + 2],
      s = this.covariances;
    const far = this.distances[this.seen[4 * i + 3]],
      allowed = Math.max(R.size, (R.growth * size) / far),
      k = 6 * i;
    let share = 2 - size / (distance * allowed);
    for (let j = 0; j < 6; j++) this.shape[j] = s[k + j];
    if (share <= 0 || far === Infinity) return Math.min(1, Math.max(0, share));
    share = Math.min(1, share);
    const a = this.directions[3 * i],
      b = this.directions[3 * i + 1],
      c = this.directions[3 * i + 2];
    const cosine = (a * x + b * y + c * z) / distance,
      from = this.shortFrom[byte];
    if (cosine >= from) return share;
    this.shorten(a, b, c, Math.min(1, (from - cosine) / (from - this.shortTo[byte])));
    const begin = this.fadeFrom[byte],
      end = this.fadeTo[byte];
    return cosine >= begin ? share : share * Math.max(0, (cosine - end) / (begin - end));
  }

  // Along a direction, to a length of at most the diagonal of its other two sides.
  shorten(a, b, c, strength) {
    const s = this.shape,
      ea = s[0] * a + s[1] * b + s[2] * c,
      eb = s[1] * a + s[3] * b + s[4] * c,
      ec = s[2] * a + s[4] * b + s[5] * c;
    const along = a * ea + b * eb + c * ec,
      beside = s[0] + s[3] + s[5] - along;
    if (along <= beside) return;
    const g = strength * (Math.sqrt(Math.max(0, beside / along)) - 1),
      h = g * g * along;
    s[0] += 2 * g * a * ea + h * a * a;
    s[1] += g * (a * eb + b * ea) + h * a * b;
    s[2] += g * (a * ec + c * ea) + h * a * c;
    s[3] += 2 * g * b * eb + h * b * b;
    s[4] += g * (b * ec + c * eb) + h * b * c;
    s[5] += 2 * g * c * ec + h * c * c;
  }
}

// Unit vectors Float32 [3n] of the first two bytes of each four: points of an octahedron, unfolded to a square.
function octahedralDirections(seen) {
  const found = new Float32Array((seen.length / 4) * 3);
  for (let i = 0, k = 0; k < seen.length; i += 3, k += 4) {
    let x = seen[k] / 127.5 - 1,
      y = seen[k + 1] / 127.5 - 1;
    const z = 1 - Math.abs(x) - Math.abs(y),
      under = Math.max(-z, 0);
    x -= x >= 0 ? under : -under;
    y -= y >= 0 ? under : -under;
    const length = Math.sqrt(x * x + y * y + z * z);
    found[i] = x / length;
    found[i + 1] = y / length;
    found[i + 2] = z / length;
  }
  return found;
}

// Where the camera of a matrix of world to camera is, column-major.
function eyeOf(v) {
  return [0, 4, 8].map((k) => -(v[k] * v[12] + v[k + 1] * v[13] + v[k + 2] * v[14]));
}
