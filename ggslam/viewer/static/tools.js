// SPDX-License-Identifier: Apache-2.0
// What a press on the map does: look around and pick, draw a selection, measure, note, crop, move.

const MASK_WIDTH = 480; // pixels that what is drawn is kept in

class Tool {
  constructor(viewer) {
    this.viewer = viewer;
  }

  start() {}
  stop() {}
  wants() {
    return false;
  } // whether it takes a press of the pointer; else the camera has it
  down() {}
  move() {}
  up() {}
  click() {}
  redraw() {}
  cancel() {
    this.stop(); // what is being drawn
  }
  escape() {
    return false;
  }
}

class LookTool extends Tool {
  click(x, y, event) {
    const { viewer } = this,
      hit = viewer.map.pick(x, y),
      mode = modeOf(event, viewer);
    if (!hit || (viewer.unit === "objects" && !hit.id)) {
      if (mode === "set") viewer.select([]);
      return;
    }
    const shape =
      viewer.unit === "objects"
        ? { kind: "objects", ids: [hit.id] }
        : { kind: "sphere", center: hit.point, radius: Math.max(0.015, 0.012 * hit.depth) };
    viewer.choose(mode, shape);
  }
}

// Shift adds, Alt takes away, Ctrl keeps what is in both; else what the panel says.
function modeOf(event, viewer) {
  if (event.shiftKey) return "add";
  if (event.altKey) return "remove";
  if (event.ctrlKey || event.metaKey) return "intersect";
  return viewer.mode;
}

// Something is drawn on the screen; what lies in it is selected.
class DrawnTool extends Tool {
  wants(event) {
    return event.button === 0 && !this.viewer.spaceDown;
  }

  down(x, y) {
    this.points = [[x, y]];
    this.shown = draw(this.outline, { class: this.style });
    this.viewer.overlay.append(this.shown);
    this.show();
  }

  move(x, y) {
    const last = this.points[this.points.length - 1];
    if (Math.hypot(x - last[0], y - last[1]) >= 2) {
      this.points.push([x, y]);
      this.show();
    }
  }

  up(x, y, event) {
    this.points.push([x, y]);
    this.shown.remove();
    const [a] = this.points,
      far = this.points.some((p) => Math.hypot(p[0] - a[0], p[1] - a[1]) > 4);
    if (!far && !this.single) {
      new LookTool(this.viewer).click(x, y, event);
      return;
    }
    this.viewer.chooseDrawn(modeOf(event, this.viewer), (context) => this.fill(context));
  }

  stop() {
    this.shown?.remove();
  }
}

class BoxTool extends DrawnTool {
  outline = "rect";
  style = "stroke";

  corners() {
    const [a] = this.points,
      b = this.points[this.points.length - 1];
    return [Math.min(a[0], b[0]), Math.min(a[1], b[1]), Math.abs(a[0] - b[0]), Math.abs(a[1] - b[1])];
  }

  show() {
    ["x", "y", "width", "height"].forEach((name, k) => this.shown.setAttribute(name, this.corners()[k]));
  }

  fill(context) {
    context.fillRect(...this.corners());
  }
}

class LassoTool extends DrawnTool {
  outline = "polygon";
  style = "stroke";

  show() {
    this.shown.setAttribute("points", this.points.map((p) => p.join(",")).join(" "));
  }

  fill(context) {
    context.beginPath();
    this.points.forEach((p, k) => (k ? context.lineTo(...p) : context.moveTo(...p)));
    context.closePath();
    context.fill();
  }
}

class BrushTool extends DrawnTool {
  outline = "polyline";
  style = "brush";
  single = true;

  show() {
    const points =
      this.points.length > 1 ? this.points : [this.points[0], [this.points[0][0] + 0.1, this.points[0][1]]];
    this.shown.setAttribute("points", points.map((p) => p.join(",")).join(" "));
    this.shown.setAttribute("stroke-width", 2 * this.viewer.brush);
  }

  fill(context) {
    const [first, ...others] = this.points;
    context.lineCap = context.lineJoin = "round";
    context.lineWidth = 2 * this.viewer.brush;
    context.beginPath();
    context.moveTo(...first);
    context.lineTo(first[0] + 0.1, first[1]);
    others.forEach((p) => context.lineTo(...p));
    context.stroke();
  }
}

class SphereTool extends Tool {
  wants(event) {
    return event.button === 0 && !this.viewer.spaceDown;
  }

  down(x, y) {
    const hit = this.viewer.map.pick(x, y);
    this.ball = hit && { center: hit.point, depth: hit.depth, x, y, radius: 0 };
    if (!hit) this.viewer.say("there is no surface there");
    else {
      this.shown = draw("circle", { class: "stroke", cx: x, cy: y, r: 0 });
      this.viewer.overlay.append(this.shown);
    }
  }

  move(x, y) {
    if (!this.ball) return;
    const pixels = Math.hypot(x - this.ball.x, y - this.ball.y);
    this.ball.radius = (pixels * this.ball.depth) / this.viewer.focal();
    this.shown.setAttribute("r", pixels);
    this.viewer.say(`radius ${metres(this.ball.radius)}`);
  }

  up(x, y, event) {
    this.shown?.remove();
    if (this.ball)
      this.viewer.choose(
        modeOf(event, this.viewer),
        { kind: "sphere", center: this.ball.center, radius: Math.max(this.ball.radius, this.viewer.radius || 0.02) },
        true,
      );
    this.ball = null;
  }

  stop() {
    this.shown?.remove();
  }
}

// The present view as a shape; fill(context) draws in CSS pixels of the canvas.
function drawnShape(viewer, fill) {
  const { canvas, camera } = viewer,
    W = canvas.clientWidth,
    H = canvas.clientHeight,
    w = Math.min(MASK_WIDTH, W),
    h = Math.max(1, Math.round((w * H) / W));
  const picture = make("canvas", { width: w, height: h }),
    context = picture.getContext("2d", { willReadFrequently: true });
  context.scale(w / W, h / H);
  context.fillStyle = context.strokeStyle = "#fff";
  fill(context);
  const runs = runsOf(context.getImageData(0, 0, w, h).data),
    v = camera.view();
  const T = [v[0], v[4], v[8], v[12], v[1], v[5], v[9], v[13], v[2], v[6], v[10], v[14], 0, 0, 0, 1];
  return {
    kind: "screen",
    T_camera_world: T,
    width: W,
    height: H,
    focal: camera.focal(W, H),
    near: camera.near,
    mask: { width: w, height: h, runs },
    seen_only: viewer.seenOnly,
  };
}

// Buttons of the tools, and what the pointer does while one is chosen.
class ToolBar {
  constructor(viewer, element) {
    this.viewer = viewer;
    this.element = element;
    this.tools = new Map();
    this.stroke = null;
    const { canvas, camera } = viewer;
    camera.taken = (event) => this.take(event);
    camera.onclick = (x, y, event) => this.current.click(x, y, event);
    canvas.addEventListener("pointermove", (event) => {
      if (event.pointerId !== this.stroke) return;
      this.pressed = [event.clientX, event.clientY];
      this.current.move(event.offsetX, event.offsetY, event);
    });
    for (const name of ["pointerup", "pointercancel"])
      canvas.addEventListener(name, (event) => {
        if (event.pointerId === this.stroke) {
          this.stroke = null;
          this.current.up(event.offsetX, event.offsetY, event);
        }
      });
  }

  take(event) {
    if (this.stroke !== null && event.pointerType === "touch") return this.giveBack();
    if (this.stroke !== null || !this.current.wants(event)) return this.stroke !== null;
    this.stroke = event.pointerId;
    this.pressed = [event.clientX, event.clientY];
    try {
      this.viewer.canvas.setPointerCapture(event.pointerId);
    } catch {
      /* gone */
    }
    this.current.down(event.offsetX, event.offsetY, event);
    return true;
  }

  // A second finger has come: both are for the camera, and nothing is drawn.
  giveBack() {
    this.viewer.camera.pointers.set(this.stroke, this.pressed);
    this.stroke = null;
    this.current.cancel();
    return false;
  }

  // What a press in the middle of the view does, for people without a pointer.
  useMiddle(event) {
    const { clientWidth, clientHeight } = this.viewer.canvas;
    const at = [Math.round(clientWidth / 2), Math.round(clientHeight / 2), event];
    if (!this.current.wants({ button: 0 })) return this.current.click(...at);
    this.current.down(...at);
    return this.current.up(...at);
  }

  // name, tool, words for people, key.
  offer(name, tool, words, key) {
    const button = make(
      "button",
      { title: `${words} (${key})`, "aria-label": words, onclick: () => this.choose(name) },
      icon(name),
    );
    this.tools.set(name, { tool, button, key });
    this.element.append(button);
    if (!this.current) this.choose(name);
  }

  line() {
    this.element.append(document.createElement("hr"));
  }

  action(name, words, key, run) {
    this.element.append(make("button", { title: `${words} (${key})`, "aria-label": words, onclick: run }, icon(name)));
  }

  choose(name) {
    this.current?.stop();
    this.name = name;
    this.current = this.tools.get(name).tool;
    for (const [other, { button }] of this.tools) button.setAttribute("aria-pressed", other === name);
    this.viewer.space.classList.toggle("drawing", !["look"].includes(name));
    this.current.start();
    this.viewer.emit("tool");
    this.viewer.remember();
  }

  byKey(key) {
    for (const [name, tool] of this.tools)
      if (tool.key === key) {
        this.choose(name);
        return true;
      }
    return false;
  }
}
