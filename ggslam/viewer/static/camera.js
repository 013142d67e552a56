// SPDX-License-Identifier: Apache-2.0
// A camera that turns about a point: drag to turn, right button or two fingers to shift, wheel or pinch to come nearer.

const add = (a, b, f = 1) => a.map((value, i) => value + f * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const length = Math.hypot(...a) || 1; return a.map((value) => value / length); };
const turned = (a, axis, angle) => {
  const c = Math.cos(angle), s = Math.sin(angle), k = cross(axis, a), d = dot(axis, a) * (1 - c);
  return a.map((value, i) => value * c + k[i] * s + axis[i] * d);
};

class OrbitCamera {
  constructor(canvas, up, fov, redraw) {
    Object.assign(this, { canvas, up: unit(up), fov, redraw, near: 0.05, position: [0, 0, 0], target: [0, 0, 1], top: up });
    this.pointers = new Map(); this.moved = 0; this.onclick = () => {};
    canvas.addEventListener("pointerdown", (event) => {
      try { canvas.setPointerCapture(event.pointerId); } catch { /* the pointer is gone already */ }
      this.pointers.set(event.pointerId, [event.clientX, event.clientY]); if (this.pointers.size === 1) this.moved = 0;
    });
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    canvas.addEventListener("pointerup", (event) => {
      if (this.pointers.size === 1 && this.moved < 5 && event.button === 0) this.onclick(event.offsetX, event.offsetY);
      this.pointers.delete(event.pointerId);
    });
    canvas.addEventListener("pointercancel", (event) => this.pointers.delete(event.pointerId));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.dolly(Math.exp(event.deltaY * 0.0012)); }, { passive: false });
  }

  look({ position, look_at, up, near }) { this.position = position; this.target = look_at; this.top = up; this.near = near; this.redraw(); }

  axes() {
    const forward = unit(add(this.target, this.position, -1));
    const right = unit(cross(forward, this.top)), down = cross(forward, right);
    return [right, down, forward];
  }

  view() { // column-major, world to camera
    const [r, d, f] = this.axes(), p = this.position;
    return new Float32Array([r[0], d[0], f[0], 0, r[1], d[1], f[1], 0, r[2], d[2], f[2], 0, -dot(r, p), -dot(d, p), -dot(f, p), 1]);
  }

  focal(width, height) { return Math.min(height, width / 1.1) / 2 / Math.tan(this.fov / 2); }

  drag(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], dx = now[0] - before[0], dy = now[1] - before[1];
    this.moved += Math.abs(dx) + Math.abs(dy);
    if (this.pointers.size === 2) {
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)[1];
      const gap = (a) => Math.hypot(a[0] - other[0], a[1] - other[1]);
      this.dolly(gap(before) / Math.max(gap(now), 1)); this.shift(dx / 2, dy / 2);
    } else if (event.buttons & 2 || event.shiftKey) this.shift(dx, dy);
    else this.turn(dx, dy);
    this.pointers.set(event.pointerId, now);
  }

  turn(dx, dy) {
    this.top = this.up; this.near = 0.05;
    let arm = add(this.position, this.target, -1);
    const [right, , forward] = this.axes(), tilt = Math.asin(Math.max(-1, Math.min(1, dot(forward, this.up))));
    const pitch = Math.max(-1.5 - tilt, Math.min(1.5 - tilt, dy * 0.006));
    arm = turned(turned(arm, right, pitch), this.up, -dx * 0.006);
    this.position = add(this.target, arm); this.redraw();
  }

  shift(dx, dy) {
    const [right, down] = this.axes(), step = Math.hypot(...add(this.position, this.target, -1)) / this.focal(this.canvas.clientWidth, this.canvas.clientHeight);
    const by = add(right.map((value) => -value * dx * step), down, -dy * step);
    this.position = add(this.position, by); this.target = add(this.target, by); this.redraw();
  }

  dolly(factor) { this.position = add(this.target, add(this.position, this.target, -1), factor); this.redraw(); }
}
