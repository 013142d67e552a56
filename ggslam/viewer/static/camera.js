// SPDX-License-Identifier: Apache-2.0
// A camera that turns about a point: drag to turn, right button or two fingers to shift, wheel or pinch to come nearer,
// keys to fly. Coordinates: x right, y down, z forward.

class OrbitCamera {
  // taken(event): whether somebody else wants a press of the pointer; onclick(x, y, event) and ondouble(x, y) are told
  // CSS pixels.
  constructor(canvas, up, fov, redraw) {
    Object.assign(this, {
      canvas,
      up: unit(up),
      fov,
      redraw,
      near: 0.05,
      position: [0, 0, 0],
      target: [0, 0, 1],
      top: up,
    });
    this.pointers = new Map();
    this.moved = 0;
    this.flying = new Set();
    this.onclick = this.ondouble = this.onuser = () => {};
    this.taken = () => false;
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    canvas.addEventListener("pointerup", (event) => {
      if (!this.pointers.has(event.pointerId)) return;
      if (this.pointers.size === 1 && this.moved < 5 && event.button === 0)
        this.onclick(event.offsetX, event.offsetY, event);
      this.pointers.delete(event.pointerId);
    });
    canvas.addEventListener("pointercancel", (event) => this.pointers.delete(event.pointerId));
    canvas.addEventListener("dblclick", (event) => this.ondouble(event.offsetX, event.offsetY));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.onuser();
        this.dolly(Math.exp(event.deltaY * 0.0012));
      },
      { passive: false },
    );
  }

  look({ position, look_at, up, near }) {
    this.gliding = 0;
    this.position = position;
    this.target = look_at;
    this.top = up;
    this.near = near || 0.05;
    this.redraw();
  }

  // Goes to a view in some moments.
  glide(view, seconds = 0.35) {
    const from = { position: this.position, target: this.target, top: this.top },
      began = performance.now(),
      run = (this.gliding = Math.random());
    this.near = view.near || 0.05;
    const step = (now) => {
      if (this.gliding !== run) return;
      const share = clamp((now - began) / (1000 * seconds), 0, 1),
        t = share * share * (3 - 2 * share);
      this.position = between(from.position, view.position, t);
      this.target = between(from.target, view.look_at, t);
      this.top = unit(between(from.top, view.up, t));
      this.redraw();
      if (share < 1) requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  state() {
    return { position: this.position, look_at: this.target, up: this.top, near: this.near };
  }

  axes() {
    const forward = unit(minus(this.target, this.position));
    const right = unit(cross(forward, this.top)),
      down = cross(forward, right);
    return [right, down, forward];
  }

  view() {
    // column-major, world to camera
    const [r, d, f] = this.axes(),
      p = this.position;
    return new Float32Array([
      r[0],
      d[0],
      f[0],
      0,
      r[1],
      d[1],
      f[1],
      0,
      r[2],
      d[2],
      f[2],
      0,
      -dot(r, p),
      -dot(d, p),
      -dot(f, p),
      1,
    ]);
  }

  focal(width, height) {
    return Math.min(height, width / 1.1) / 2 / Math.tan(this.fov / 2);
  }

  // Where a point is on the canvas, [x, y, depth] in CSS pixels and metres; null: behind the camera.
  project(point) {
    const [r, d, f] = this.axes(),
      from = minus(point, this.position),
      z = dot(f, from);
    if (z < this.near) return null;
    const width = this.canvas.clientWidth,
      height = this.canvas.clientHeight,
      focal = this.focal(width, height);
    return [width / 2 + (focal * dot(r, from)) / z, height / 2 + (focal * dot(d, from)) / z, z];
  }

  // The direction that a place of the canvas looks in, of length 1 along the optical axis.
  ray(x, y) {
    const [r, d, f] = this.axes(),
      width = this.canvas.clientWidth,
      height = this.canvas.clientHeight,
      focal = this.focal(width, height);
    return add(add(f, r, (x - width / 2) / focal), d, (y - height / 2) / focal);
  }

  press(event) {
    if (this.pointers.size === 0 && this.taken(event)) return;
    try {
      this.canvas.setPointerCapture(event.pointerId);
    } catch {
      /* the pointer is gone already */
    }
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (this.pointers.size === 1) this.moved = 0;
  }

  drag(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY],
      dx = now[0] - before[0],
      dy = now[1] - before[1];
    this.moved += Math.abs(dx) + Math.abs(dy);
    if (this.moved >= 5) this.onuser();
    if (this.pointers.size === 2) {
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)[1];
      const gap = (a) => Math.hypot(a[0] - other[0], a[1] - other[1]);
      this.dolly(gap(before) / Math.max(gap(now), 1));
      this.shift(dx / 2, dy / 2);
    } else if (event.buttons & 2 || event.shiftKey) this.shift(dx, dy);
    else this.turn(dx, dy);
    this.pointers.set(event.pointerId, now);
  }

  turn(dx, dy) {
    this.gliding = 0;
    this.top = this.up;
    this.near = 0.05;
    let arm = minus(this.position, this.target);
    const [right, , forward] = this.axes(),
      tilt = Math.asin(clamp(dot(forward, this.up), -1, 1));
    const pitch = Math.max(-1.5 - tilt, Math.min(1.5 - tilt, dy * 0.006));
    arm = turned(turned(arm, right, pitch), this.up, -dx * 0.006);
    this.position = add(this.target, arm);
    this.redraw();
  }

  shift(dx, dy) {
    this.gliding = 0;
    const [right, down] = this.axes(),
      step = length(minus(this.position, this.target)) / this.focal(this.canvas.clientWidth, this.canvas.clientHeight);
    const by = add(times(right, -dx * step), down, -dy * step);
    this.position = add(this.position, by);
    this.target = add(this.target, by);
    this.redraw();
  }

  dolly(factor) {
    this.gliding = 0;
    this.position = add(this.target, minus(this.position, this.target), factor);
    this.redraw();
  }

  // Looks at a point from where it is.
  lookAt(point) {
    const view = { ...this.state(), look_at: point, up: this.up };
    this.glide(view);
  }

  // Flies while keys are down. directions: of {forward, back, left, right, up, down}.
  fly(direction, down, fast) {
    this.fast = fast;
    down ? this.flying.add(direction) : this.flying.delete(direction);
    if (!this.flying.size || this.flightBegan) return;
    this.onuser();
    this.top = this.up;
    this.near = 0.05;
    this.gliding = 0;
    this.flightBegan = performance.now();
    const step = (now) => {
      const seconds = Math.min(0.1, (now - this.flightBegan) / 1000);
      this.flightBegan = now;
      if (!this.flying.size) {
        this.flightBegan = 0;
        return;
      }
      const [right, , forward] = this.axes(),
        ways = {
          forward,
          back: times(forward, -1),
          left: times(right, -1),
          right,
          up: this.up,
          down: times(this.up, -1),
        };
      const way = [...this.flying].reduce((sum, name) => add(sum, ways[name]), [0, 0, 0]),
        speed = this.fast ? 4 : 1.2;
      this.position = add(this.position, way, speed * seconds);
      this.target = add(this.target, way, speed * seconds);
      this.redraw();
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  // Turns in place, by keys; in pixels of a drag.
  turnHead(dx, dy) {
    this.onuser();
    this.top = this.up;
    this.near = 0.05;
    this.gliding = 0;
    const [right, , forward] = this.axes(),
      tilt = Math.asin(clamp(dot(forward, this.up), -1, 1)),
      far = length(minus(this.target, this.position));
    const pitch = clamp(dy * 0.006, -1.5 - tilt, 1.5 - tilt);
    this.target = add(this.position, turned(turned(forward, right, pitch), this.up, -dx * 0.006), far);
    this.redraw();
  }
}
