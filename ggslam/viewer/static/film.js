// SPDX-License-Identifier: Apache-2.0
// The camera of a film: keys that people set, and the way through them. `ggslam render --path keys.json` goes the same
// way (jobs/render/key_path.py states the same formulas).

// keys: [{time, position, look_at, up, fov}] with rising times, in seconds, metres and radians. Positions and points
// that are looked at lie on centripetal Catmull-Rom curves, up turns on a great circle, fov changes evenly.
function cameraAt(keys, time) {
  let k = 0;
  while (k < keys.length - 2 && time >= keys[k + 1].time) k++;
  const a = keys[k];
  const b = keys[Math.min(k + 1, keys.length - 1)];
  const share = b === a ? 0 : clamp((time - a.time) / (b.time - a.time), 0, 1);
  const curve = (name) =>
    curvePoint(
      keys.map((key) => key[name]),
      k,
      share,
    );
  return {
    time,
    position: curve("position"),
    look_at: curve("look_at"),
    up: greatCircle(unit(a.up), unit(b.up), share),
    fov: a.fov + share * (b.fov - a.fov),
  };
}

// The point at `share` in [0, 1] between points number k and k + 1; beyond the ends they are reflected.
function curvePoint(points, k, share) {
  if (points.length === 1) return points[0];
  const beyond = (end, next) => minus(times(end, 2), next);
  const all = [beyond(points[0], points[1]), ...points, beyond(points.at(-1), points.at(-2))];
  const p = all.slice(k, k + 4);
  const apart = [0, 1, 2].map((i) => Math.sqrt(length(minus(p[i + 1], p[i]))));
  if (apart[1] < 1e-9) return p[1];
  const knots = [0];
  for (const gap of apart) knots.push(knots.at(-1) + (gap < 1e-9 ? apart[1] : gap));
  const t = knots[1] + share * (knots[2] - knots[1]);
  const at = (a, b, low, high) => between(a, b, (t - knots[low]) / (knots[high] - knots[low]));
  const [first, second, third] = [0, 1, 2].map((i) => at(p[i], p[i + 1], i, i + 1));
  return at(at(first, second, 0, 2), at(second, third, 1, 3), 1, 2);
}

// The direction at `share` of the way from one to another, both of length 1.
function greatCircle(a, b, share) {
  const angle = Math.acos(clamp(dot(a, b), -1, 1));
  if (angle < 1e-6 || angle > Math.PI - 1e-6) return share < 0.5 ? a : b;
  return times(add(times(a, Math.sin((1 - share) * angle)), b, Math.sin(share * angle)), 1 / Math.sin(angle));
}

// Keys out of a file of anybody's; throws what is wrong.
function readKeys(text) {
  const values = JSON.parse(text);
  const given = Array.isArray(values) ? values : values?.keys;
  const vector = (v) => Array.isArray(v) && v.length === 3 && v.every(Number.isFinite);
  if (!Array.isArray(given) || !given.length || given.length > 10000) throw new Error("expected camera keys");
  const keys = given.map((key) => {
    if (!key || !Number.isFinite(key.time) || !vector(key.position) || !vector(key.look_at) || !vector(key.up))
      throw new Error("a key lacks time, position, look_at or up");
    const fov = key.fov > 0.01 && key.fov < 3 ? key.fov : null;
    return { time: key.time, position: key.position, look_at: key.look_at, up: key.up, fov };
  });
  if (keys.some((key, k) => k > 0 && key.time <= keys[k - 1].time)) throw new Error("the times of the keys must rise");
  return keys;
}

class Film {
  constructor(viewer, keys) {
    this.viewer = viewer;
    this.keys = keys || [];
    viewer.on("user", () => {
      this.running = false;
    });
  }

  add() {
    const { camera } = this.viewer;
    const { position, look_at, up } = camera.state();
    const last = this.keys.at(-1);
    this.keys.push({ time: last ? last.time + 2 : 0, position, look_at, up, fov: camera.fov });
    this.changed();
    this.viewer.say(`key ${this.keys.length} of the film`);
  }

  // Keys that are kept now, perhaps added by another page; those of a map that grew are not kept anywhere yet.
  kept(keys) {
    if (!keys || (!keys.length && !this.inFile)) return;
    this.inFile = true;
    this.keys = keys;
    this.viewer.emit("film");
  }

  take(keys) {
    this.keys = keys;
    this.changed();
  }

  remove(k) {
    this.keys.splice(k, 1);
    this.changed();
  }

  // Keys change places; their times stay.
  swap(k, other) {
    const { keys } = this;
    if (!keys[k] || !keys[other]) return;
    [keys[k], keys[other]] = [
      { ...keys[other], time: keys[k].time },
      { ...keys[k], time: keys[other].time },
    ];
    this.changed();
  }

  setTime(k, time) {
    if (!(time >= 0) || this.keys.some((key, other) => other !== k && key.time === time)) {
      this.viewer.say("each key needs a time of its own, in seconds from 0", true);
      this.viewer.emit("film");
      return;
    }
    this.keys[k].time = time;
    this.keys.sort((a, b) => a.time - b.time);
    this.changed();
  }

  go(k) {
    const { position, look_at, up } = this.keys[k];
    this.viewer.camera.glide({ position, look_at, up });
  }

  // All keys have an angle of view.
  complete() {
    return this.keys.map((key) => ({ ...key, fov: key.fov || this.viewer.scene.fov }));
  }

  text(fps) {
    return JSON.stringify({ fps, keys: this.complete() }, null, 1);
  }

  async changed() {
    const { viewer } = this;
    viewer.emit("film");
    if (!viewer.keeps()) return;
    this.inFile = true;
    await viewer.keep("camera-keys", { fps: 30, keys: this.complete() });
  }

  // Shows the film, or ends it.
  play() {
    if (this.running) {
      this.running = false;
      return;
    }
    if (this.keys.length < 2) return;
    const { camera } = this.viewer;
    const began = performance.now();
    const keys = this.complete();
    this.running = true;
    this.viewer.emit("film");
    const step = (now) => {
      const time = keys[0].time + (now - began) / 1000;
      const at = cameraAt(keys, time);
      camera.fov = at.fov;
      camera.look(at);
      if (this.running && time < keys.at(-1).time) requestAnimationFrame(step);
      else this.end();
    };
    requestAnimationFrame(step);
  }

  end() {
    this.running = false;
    this.viewer.camera.fov = this.viewer.scene.fov;
    this.viewer.camera.redraw();
    this.viewer.emit("film");
  }
}
