// SPDX-License-Identifier: Apache-2.0
// Measuring on the surface: places, distances along a line of points, heights above the floor.

class MeasureTool extends Tool {
  points = [];

  start() {
    this.viewer.say("click on the map; Backspace takes a point back, Escape begins anew");
  }

  click(x, y) {
    const hit = this.viewer.map.pick(x, y);
    if (!hit) {
      this.viewer.say("there is no surface there");
      return;
    }
    this.points.push(hit.point);
    this.changed();
  }

  back() {
    this.points.pop();
    this.changed();
  }

  escape() {
    const any = this.points.length > 0;
    this.points = [];
    this.changed();
    return any;
  }

  stop() {
    this.points = [];
    this.changed();
  }

  changed() {
    const { map } = this.viewer;
    if (this.points.length > 1) map.setLines("measured", segmentsOf(this.points), [255, 176, 33], 2.5);
    else map.dropLines("measured");
    this.viewer.emit("measured");
    this.viewer.redrawOverlay();
  }

  distances() {
    return this.points.slice(1).map((p, k) => length(minus(p, this.points[k])));
  }

  heights() {
    const { floor, up } = this.viewer.scene;
    return floor.found ? this.points.map((p) => dot(p, up) - floor.height) : null;
  }

  // What was measured, for people.
  lines() {
    const heights = this.heights(),
      found = this.points.map(
        (p, k) =>
          `${k + 1}: ${p.map((value) => value.toFixed(3)).join(", ")} m${heights ? ` · ${metres(heights[k])} above the floor` : ""}`,
      );
    const parts = this.distances(),
      total = parts.reduce((sum, value) => sum + value, 0);
    if (parts.length)
      found.push(`distance ${metres(total)}${parts.length > 1 ? ` (${parts.map(metres).join(" + ")})` : ""}`);
    return found;
  }

  redraw(labels, dots) {
    this.points.forEach((p) => dots.push(p));
    this.distances().forEach((value, k) =>
      labels.push({ point: between(this.points[k], this.points[k + 1], 0.5), text: metres(value) }),
    );
  }
}

// Size and middle of what is selected, along the upright axes: {size [level, level, height], center, low}.
function boxOfSelected(viewer) {
  const axes = uprightAxes(viewer.scene.up),
    low = [Infinity, Infinity, Infinity],
    high = [-Infinity, -Infinity, -Infinity];
  let count = 0;
  for (const [chunk, splats] of viewer.map.chunks) {
    const marks = viewer.chosen.get(chunk);
    for (let i = 0; marks && i < splats.count; i++) {
      if (!marks[i]) continue;
      count++;
      for (let k = 0; k < 3; k++) {
        const value =
          axes[k][0] * splats.centers[3 * i] +
          axes[k][1] * splats.centers[3 * i + 1] +
          axes[k][2] * splats.centers[3 * i + 2];
        if (value < low[k]) low[k] = value;
        if (value > high[k]) high[k] = value;
      }
    }
  }
  if (!count) return null;
  const middle = low.map((value, k) => (value + high[k]) / 2);
  return {
    count,
    axes,
    size: high.map((value, k) => value - low[k]),
    center: axes.reduce((p, axis, k) => add(p, axis, middle[k]), [0, 0, 0]),
    low,
  };
}
