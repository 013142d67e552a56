// SPDX-License-Identifier: Apache-2.0
// Handles in space: arms that move what is selected along an axis, a ring that turns it about up, faces of a crop box.

const AXIS_COLORS = ["#e5484d", "#46a758", "#4082e6"];
const TURN_COLOR = "#ffb021";
const ARM_PIXELS = 90; // length of the arms on the screen

// A handle on the overlay at `place()` (world) that follows the pointer along `direction()` (world, a unit vector).
// onmove(by): metres since the press; from(): where its arm begins, null: it has none.
class AxisHandle {
  constructor(viewer, { color, place, direction, onstart = () => {}, onmove, from = () => null, words }) {
    Object.assign(this, { viewer, place, direction, onmove, from });
    this.arm = draw("line", { class: "arm", stroke: color });
    this.dot = draw("circle", { class: "handle", r: 8, fill: color, style: "display: none" });
    const title = draw("title");
    title.textContent = words;
    this.dot.append(title);
    viewer.overlay.append(this.arm, this.dot);
    this.dot.addEventListener("pointerdown", (event) => {
      event.stopPropagation();
      this.dot.setPointerCapture(event.pointerId);
      this.pressed = { at: [event.clientX, event.clientY], place: place(), direction: direction() };
      onstart();
    });
    this.dot.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"])
      this.dot.addEventListener(name, () => {
        this.pressed = null;
      });
  }

  drag(event) {
    if (!this.pressed) return;
    const { at, place, direction } = this.pressed;
    const { camera } = this.viewer;
    const a = camera.project(place);
    const step = 0.01 * (a ? a[2] : 1);
    const b = camera.project(add(place, direction, step));
    if (!a || !b) return;
    const way = [b[0] - a[0], b[1] - a[1]];
    const size = way[0] ** 2 + way[1] ** 2;
    if (size < 1e-6) return; // it points at the camera
    this.onmove((((event.clientX - at[0]) * way[0] + (event.clientY - at[1]) * way[1]) / size) * step);
  }

  redraw() {
    const at = this.viewer.camera.project(this.place());
    const begin = this.from() && this.viewer.camera.project(this.from());
    this.dot.style.display = at ? "" : "none";
    this.arm.style.display = at && begin ? "" : "none";
    if (at) setAttributes(this.dot, { cx: at[0], cy: at[1] });
    if (at && begin) setAttributes(this.arm, { x1: begin[0], y1: begin[1], x2: at[0], y2: at[1] });
  }

  remove() {
    this.dot.remove();
    this.arm.remove();
  }
}

class MoveTool extends Tool {
  start() {
    const box = boxOfSelected(this.viewer);
    if (!box || !this.viewer.edits.can("move")) {
      this.viewer.say(
        box
          ? "this page cannot move things; `ggslam view RUN` serves one that can"
          : "select what is to be moved first",
      );
      return;
    }
    this.box = box;
    this.shift = [0, 0, 0];
    this.angle = 0;
    this.who = this.viewer.movedWho();
    this.makeHandles();
    if (!this.viewer.inView(box.center)) this.viewer.say("the handles are out of sight; F looks at them");
    this.viewer.emit("moved");
    this.viewer.redrawOverlay();
  }

  makeHandles() {
    const { viewer, box } = this;
    let before;
    const onstart = () => {
      before = { shift: this.shift, angle: this.angle };
    };
    const middle = () => add(box.center, this.shift);
    const reach = () => ARM_PIXELS * viewer.metresPerPixel(middle());
    this.handles = box.axes.map(
      (axis, k) =>
        new AxisHandle(viewer, {
          color: AXIS_COLORS[k],
          words: ["to the side", "to the front", "up"][k],
          place: () => add(middle(), axis, reach()),
          direction: () => axis,
          from: middle,
          onstart,
          onmove: (by) => this.set(add(before.shift, axis, by), this.angle),
        }),
    );
    const arm = () => turned(box.axes[0], box.axes[2], this.angle + Math.PI / 4);
    this.handles.push(
      new AxisHandle(viewer, {
        color: TURN_COLOR,
        words: "turn",
        place: () => add(middle(), arm(), reach()),
        direction: () => cross(box.axes[2], arm()),
        onstart,
        onmove: (by) => this.set(this.shift, before.angle + by / reach()),
      }),
    );
    this.ring = draw("polyline", { class: "ring", stroke: TURN_COLOR });
    this.ringPoints = () =>
      Array.from({ length: 49 }, (_, k) =>
        add(middle(), turned(box.axes[0], box.axes[2], (k * Math.PI) / 24), reach()),
      );
    viewer.overlay.prepend(this.ring);
  }

  set(shift, angle) {
    this.shift = shift;
    this.angle = angle;
    const T = this.motion();
    this.viewer.map.displace(transposed(T), this.who);
    this.viewer.drawSelectionBox(T);
    this.viewer.emit("moved");
    this.viewer.redrawOverlay();
  }

  // How far along the upright axes, in metres, and the turn in degrees.
  numbers() {
    return this.box ? [...this.box.axes.map((axis) => dot(axis, this.shift)), (this.angle * 180) / Math.PI] : null;
  }

  setNumbers([a, b, c, degrees]) {
    this.set(
      [a, b, c].reduce((sum, value, k) => add(sum, this.box.axes[k], value), [0, 0, 0]),
      (degrees * Math.PI) / 180,
    );
  }

  motion() {
    return motionOf(this.box.center, this.box.axes[2], this.angle, this.shift);
  }

  async apply() {
    const T = this.motion();
    if (length(this.shift) < 1e-6 && Math.abs(this.angle) < 1e-6) return;
    await this.viewer.edit({ kind: "move", T, selection: this.viewer.steps });
    this.viewer.tools.choose("look");
  }

  stop() {
    this.handles?.forEach((handle) => handle.remove());
    this.ring?.remove();
    this.handles = this.ring = this.box = null;
    this.viewer.map.displace(null);
    this.viewer.drawSelectionBox();
    this.viewer.emit("moved");
    this.viewer.redrawOverlay();
  }

  escape() {
    if (!this.box) return false;
    this.viewer.tools.choose("look");
    return true;
  }

  redraw() {
    this.handles?.forEach((handle) => handle.redraw());
    const points = this.ring && this.ringPoints().map((point) => this.viewer.camera.project(point));
    if (points)
      this.ring.setAttribute("points", points.every(Boolean) ? points.map(([x, y]) => `${x},${y}`).join(" ") : "");
  }
}

class CropTool extends Tool {
  start() {
    const box = boxOfSelected(this.viewer) || this.viewer.wholeBox();
    this.box = { center: box.center, axes: box.axes, size: box.size.map((value) => Math.max(value, 0.05)) };
    this.yaw = 0;
    this.handles = [0, 1, 2].flatMap((k) => [1, -1].map((side) => this.faceHandle(k, side)));
    this.set(this.box);
  }

  faceHandle(k, side) {
    let before;
    return new AxisHandle(this.viewer, {
      color: AXIS_COLORS[k],
      words: "a face of the box",
      place: () => add(this.box.center, this.box.axes[k], (side * this.box.size[k]) / 2),
      direction: () => times(this.box.axes[k], side),
      onstart: () => {
        before = this.box;
      },
      onmove: (by) => {
        const grow = Math.max(by, 0.02 - before.size[k]);
        const size = before.size.map((value, j) => (j === k ? value + grow : value));
        this.set({ ...this.box, center: add(before.center, this.box.axes[k], (side * grow) / 2), size });
      },
    });
  }

  set(box) {
    this.box = box;
    this.viewer.map.setLines("crop", boxSegments(box), [255, 235, 60], 2);
    this.viewer.emit("cropped");
    this.viewer.redrawOverlay();
  }

  setYaw(degrees) {
    const [a, b, up] = uprightAxes(this.viewer.scene.up),
      angle = (degrees * Math.PI) / 180;
    this.yaw = degrees;
    this.set({ ...this.box, axes: [turned(a, up, angle), turned(b, up, angle), up] });
  }

  shape() {
    return { kind: "box", center: this.box.center, axes: this.box.axes, size: this.box.size };
  }

  stop() {
    this.handles?.forEach((handle) => handle.remove());
    this.handles = null;
    this.box = null;
    this.viewer.map.dropLines("crop");
    this.viewer.emit("cropped");
  }

  escape() {
    this.viewer.tools.choose("look");
    return true;
  }

  redraw() {
    this.handles?.forEach((handle) => handle.redraw());
  }
}
