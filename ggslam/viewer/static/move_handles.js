// SPDX-License-Identifier: Apache-2.0
// Handles in space: arms that move what is selected along an axis, a ring that turns it about up, faces of a crop box.

const AXIS_COLORS = ["#e5484d", "#46a758", "#4082e6"];

// A handle on the overlay at `place()` (world) that follows the pointer along `direction()` (world, a unit vector).
class AxisHandle {
  constructor(viewer, color, place, direction, onmove, onend) {
    Object.assign(this, { viewer, place, direction, onmove, onend });
    this.dot = draw("circle", { class: "handle", r: 8, fill: color });
    viewer.overlay.append(this.dot);
    this.dot.addEventListener("pointerdown", (event) => {
      event.stopPropagation();
      this.dot.setPointerCapture(event.pointerId);
      this.from = [event.clientX, event.clientY];
      this.start = place();
    });
    this.dot.addEventListener("pointermove", (event) => {
      if (!this.from) return;
      const { camera } = viewer,
        a = camera.project(this.start),
        b = camera.project(add(this.start, direction(), 0.01 * (a ? a[2] : 1)));
      if (!a || !b) return;
      const way = [b[0] - a[0], b[1] - a[1]],
        size = Math.hypot(...way);
      if (size < 1e-3) return;
      onmove(
        (((event.clientX - this.from[0]) * way[0] + (event.clientY - this.from[1]) * way[1]) / (size * size)) *
          0.01 *
          a[2],
      );
    });
    this.dot.addEventListener("pointerup", () => {
      if (this.from) {
        this.from = null;
        onend();
      }
    });
  }

  redraw() {
    const at = this.viewer.camera.project(this.place());
    this.dot.style.display = at ? "" : "none";
    if (at) {
      this.dot.setAttribute("cx", at[0]);
      this.dot.setAttribute("cy", at[1]);
    }
  }

  remove() {
    this.dot.remove();
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
    this.center = box.center;
    this.shift = [0, 0, 0];
    this.angle = 0;
    const reach = () => 0.5 * Math.max(...box.size) + 0.1;
    let before;
    this.handles = box.axes.map(
      (axis, k) =>
        new AxisHandle(
          this.viewer,
          AXIS_COLORS[k],
          () => add(add(box.center, this.shift), axis, reach()),
          () => axis,
          (by) => {
            before ||= this.shift;
            this.set(add(before, axis, by), this.angle);
          },
          () => {
            before = null;
          },
        ),
    );
    let angleBefore = null;
    const ring = () => turned(box.axes[0], box.axes[2], this.angle + Math.PI / 4),
      tangent = () => cross(box.axes[2], ring());
    this.handles.push(
      new AxisHandle(
        this.viewer,
        "#ffb021",
        () => add(add(box.center, this.shift), ring(), reach()),
        tangent,
        (by) => {
          angleBefore ??= this.angle;
          this.set(this.shift, angleBefore + by / reach());
        },
        () => {
          angleBefore = null;
        },
      ),
    );
    this.viewer.redrawOverlay();
  }

  set(shift, angle) {
    this.shift = shift;
    this.angle = angle;
    this.viewer.map.displace(transposed(this.motion()), this.viewer.movedWho());
    this.viewer.emit("moved");
    this.viewer.redrawOverlay();
  }

  // How far along the upright axes, and the turn in degrees.
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
    return motionOf(this.center, this.box.axes[2], this.angle, this.shift);
  }

  async apply() {
    const T = this.motion(),
      selection = this.viewer.steps;
    if (length(this.shift) < 1e-6 && Math.abs(this.angle) < 1e-6) return;
    await this.viewer.edit({ kind: "move", T, selection });
    this.stop();
    this.viewer.select([]);
    this.viewer.tools.choose("look");
  }

  stop() {
    this.handles?.forEach((handle) => handle.remove());
    this.handles = this.box = null;
    this.viewer.map.displace(null);
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
  }
}

class CropTool extends Tool {
  start() {
    const box = boxOfSelected(this.viewer) || this.viewer.wholeBox();
    this.box = { center: box.center, axes: box.axes, size: box.size.map((value) => Math.max(value, 0.05)) };
    this.yaw = 0;
    let before;
    this.handles = [0, 1, 2].flatMap((k) =>
      [1, -1].map(
        (side) =>
          new AxisHandle(
            this.viewer,
            AXIS_COLORS[k],
            () => add(this.box.center, this.box.axes[k], (side * this.box.size[k]) / 2),
            () => times(this.box.axes[k], side),
            (by) => {
              before ||= { center: this.box.center, size: this.box.size };
              const grow = Math.max(by, 0.02 - before.size[k]);
              this.set({
                ...this.box,
                center: add(before.center, this.box.axes[k], (side * grow) / 2),
                size: before.size.map((value, j) => (j === k ? value + grow : value)),
              });
            },
            () => {
              before = null;
            },
          ),
      ),
    );
    this.set(this.box);
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
