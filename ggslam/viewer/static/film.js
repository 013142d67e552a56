// SPDX-License-Identifier: Apache-2.0
// The path of a film's camera through keys: `ggslam render --path keys.json` takes the same way.

// keys: [{time, position, look_at, up, fov}] in rising order of time. A cubic through position, look_at and fov, with
// the slopes of Catmull and Rom for keys at uneven times; up is turned evenly.
function cameraAt(keys, time) {
  const t = clamp(time, keys[0].time, keys[keys.length - 1].time);
  let k = 0;
  while (k < keys.length - 2 && t > keys[k + 1].time) k++;
  const a = keys[k], b = keys[Math.min(k + 1, keys.length - 1)], span = b.time - a.time, s = span > 0 ? (t - a.time) / span : 0;
  const cubic = (of) => {
    const p = of(a), q = of(b), m = slopeAt(keys, k, of), n = slopeAt(keys, Math.min(k + 1, keys.length - 1), of);
    const h = [2 * s ** 3 - 3 * s ** 2 + 1, s ** 3 - 2 * s ** 2 + s, -2 * s ** 3 + 3 * s ** 2, s ** 3 - s ** 2];
    return p.map((_, i) => h[0] * p[i] + h[1] * span * m[i] + h[2] * q[i] + h[3] * span * n[i]);
  };
  return { time, position: cubic((key) => key.position), look_at: cubic((key) => key.look_at), up: unit(between(a.up, b.up, s)), fov: cubic((key) => [key.fov])[0] };
}

// Change a second at a key: between its neighbours'; at the ends that of the only neighbour.
function slopeAt(keys, k, of) {
  const before = keys[Math.max(k - 1, 0)], after = keys[Math.min(k + 1, keys.length - 1)], span = after.time - before.time;
  return span > 0 ? minusAny(of(after), of(before)).map((value) => value / span) : of(before).map(() => 0);
}

const minusAny = (a, b) => a.map((value, i) => value - b[i]);

// Keys out of a file of anybody's; throws what is wrong.
function readKeys(text) {
  const values = JSON.parse(text), vector = (v) => Array.isArray(v) && v.length === 3 && v.every(Number.isFinite);
  if (!values || !Array.isArray(values.keys)) throw new Error("expected camera keys");
  return values.keys.slice(0, 10000).map((key) => {
    if (!Number.isFinite(key.time) || !vector(key.position) || !vector(key.look_at) || !vector(key.up)) throw new Error("a key lacks time, position, look_at or up");
    return { time: key.time, position: key.position, look_at: key.look_at, up: key.up, fov: Number.isFinite(key.fov) ? key.fov : null };
  }).sort((a, b) => a.time - b.time);
}
