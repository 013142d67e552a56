// SPDX-License-Identifier: Apache-2.0
// Lines of the world over the map: paths, frusta, boxes, what is measured. Drawn with the camera of the picture below.

class MapLines {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.sets = new Map();
    this.clean = true;
  }

  // segments: Float32Array [6 k], ends of k segments in the world; color [r, g, b]; width in CSS pixels.
  set(name, segments, color, width) {
    this.sets.set(name, { segments, color, width });
  }

  drop(name) {
    this.sets.delete(name);
  }

  // shot: {view, focal, near, width} of any size of picture.
  draw({ view, focal, near, width }) {
    const { canvas, context } = this,
      pixels = devicePixelRatio;
    if (this.clean && !this.sets.size) return;
    const wide = Math.round(canvas.clientWidth * pixels),
      tall = Math.round(canvas.clientHeight * pixels);
    if (canvas.height !== tall) canvas.height = tall;
    canvas.width = wide; // empties it; chromium forgets a clearRect that only lines out of sight follow
    for (const { segments, color, width: thick } of this.sets.values()) {
      context.beginPath();
      context.lineWidth = thick * pixels;
      context.lineCap = "round";
      context.strokeStyle = `rgb(${color})`;
      this.trace(segments, view, (focal * wide) / width, near, wide / 2, tall / 2);
      context.stroke();
    }
    this.clean = !this.sets.size;
  }

  trace(segments, v, focal, near, middleX, middleY) {
    const at = (k) =>
      [0, 1, 2].map(
        (row) => v[row] * segments[k] + v[row + 4] * segments[k + 1] + v[row + 8] * segments[k + 2] + v[row + 12],
      );
    const place = ([x, y, z]) => [middleX + (focal * x) / z, middleY + (focal * y) / z];
    let last = null;
    for (let k = 0; k < segments.length; k += 6) {
      let a = at(k),
        b = at(k + 3);
      if (a[2] < near && b[2] < near) {
        last = null;
        continue;
      }
      if (a[2] < near) a = cutOff(a, b, near);
      const end = b[2] < near ? cutOff(b, a, near) : b,
        from = place(a),
        to = place(end);
      if (!last || last[0] !== from[0] || last[1] !== from[1]) this.context.moveTo(...from); // a path goes on: joined
      this.context.lineTo(...to);
      last = to;
    }
  }
}

// Where a segment that starts behind the near plane comes out of it.
function cutOff(behind, before, near) {
  const share = (near - behind[2]) / (before[2] - behind[2]);
  return behind.map((value, i) => value + share * (before[i] - value));
}

// A polyline of points [x, y, z] as segments.
function segmentsOf(points) {
  const found = new Float32Array(6 * Math.max(0, points.length - 1));
  for (let i = 0; i + 1 < points.length; i++) {
    found.set(points[i], 6 * i);
    found.set(points[i + 1], 6 * i + 3);
  }
  return found;
}
