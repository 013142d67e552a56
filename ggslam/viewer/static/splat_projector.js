// SPDX-License-Identifier: Apache-2.0
// Splats on the screen, nearest first, for the painter of tiles. Runs in workers.

class SplatProjector {
  constructor() {
    this.capacity = 0;
    this.count = 0;
    this.flat = new Float64Array(3);
    this.logarithms = Float64Array.from({ length: 256 }, (_, byte) => (byte ? Math.log(byte) : -1)); // of 255 alpha
  }

  // Room for so many splats. Conic: (a dx^2 + 2 b dx dy + c dy^2) / 2 is the exponent at an offset from the middle.
  reserve(count) {
    if (count <= this.capacity) return;
    this.capacity = count;
    for (const name of ["x", "y", "a", "b", "c", "opacity", "limit", "reachY", "red", "green", "blue"])
      this[name] = new Float32Array(count);
    this.depth = new Float32Array(count);
    this.depthBits = new Uint32Array(this.depth.buffer);
    this.bins = new Uint16Array(count);
    this.order = new Uint32Array(count);
  }

  // chunks: {count, centers, covariances, alphas, ids, rgb, marks, radius, shapes}; top, bottom: rows of the picture
  // that are wanted; asDepth: colours are (depth, 1, 0).
  project(chunks, states, displacement, shot, top, bottom, asDepth) {
    this.reserve(chunks.reduce((sum, chunk) => sum + chunk.count, 0));
    this.count = 0;
    this.asDepth = asDepth;
    const frame = frameOf(shot, top, bottom);
    const cameras = [shot.view, displacement && multiply(shot.view, displacement.T)].map(
      (view) => view && cameraOf(view),
    );
    for (const chunk of chunks) this.projectChunk(chunk, states, displacement, cameras, frame);
    countingSort(this.depthBits, this.bins, this.order, this.count);
  }

  // Leaves out what is not drawn and what lies beside the picture.
  projectChunk(chunk, states, displacement, [still, moved], frame) {
    const { count, centers, ids, marks, radius } = chunk,
      { near, right, above, below, stretchX, stretchY } = frame;
    for (let i = 0; i < count; i++) {
      const state = states[ids[i]];
      const mark = marks ? marks[i] : 0;
      if (!(state & SPLAT_RULES.visible) || mark & SPLAT_RULES.gone) continue;
      const camera = displacement && isDisplaced(displacement, ids[i], mark) ? moved : still,
        { rows } = camera;
      const x = centers[3 * i];
      const y = centers[3 * i + 1];
      const z = centers[3 * i + 2];
      const depth = rows[8] * x + rows[9] * y + rows[10] * z + rows[11];
      if (depth < near) continue;
      const across = rows[0] * x + rows[1] * y + rows[2] * z + rows[3];
      const wide = right * depth + radius[i] * stretchX;
      if (across > wide || across < -wide) continue;
      const down = rows[4] * x + rows[5] * y + rows[6] * z + rows[7];
      const reach = radius[i] * stretchY;
      if (down - below * depth > reach || above * depth - down > reach) continue;
      const tinted = (state & SPLAT_RULES.selected) !== 0 || (mark & SPLAT_RULES.marked) !== 0;
      this.place(chunk, i, camera, across, down, depth, frame, tinted);
    }
  }

  // Adds splat i, whose middle is at (x, y, z) from the camera, with its ellipse on the screen.
  place(chunk, i, { rows: w, eye }, x, y, z, frame, tinted) {
    const { focal, lowPass, limitX, limitY } = frame,
      { centers, alphas, shapes, radius } = chunk;
    let s = chunk.covariances,
      k = 6 * i,
      share = 1;
    if (shapes) {
      share = shapes.look(
        i,
        eye[0] - centers[3 * i],
        eye[1] - centers[3 * i + 1],
        eye[2] - centers[3 * i + 2],
        radius[i] / 3.34,
      );
      s = shapes.shape;
      k = 0;
    }
    const limit = share > 0 ? this.logarithms[alphas[i]] - frame.faint + (share < 1 ? Math.log(share) : 0) : 0;
    if (limit <= 0) return;
    const u = x / z;
    const v = y / z;
    const square = (focal / z) * (focal / z);
    const ju = u < -limitX ? -limitX : u > limitX ? limitX : u;
    const jv = v < -limitY ? -limitY : v > limitY ? limitY : v;
    this.flatten(s, k, w, ju, jv);
    const xx = square * this.flat[0] + lowPass;
    const xy = square * this.flat[1];
    const yy = square * this.flat[2] + lowPass;
    const reachY = Math.sqrt(2 * limit * yy);
    const screenY = frame.middleY + focal * v;
    if (screenY + reachY < frame.top || screenY - reachY > frame.bottom - 1) return;
    const reachX = Math.sqrt(2 * limit * xx);
    const screenX = frame.middleX + focal * u;
    if (screenX + reachX < 0 || screenX - reachX > frame.width - 1) return;
    const n = this.count++;
    const inverse = 1 / (xx * yy - xy * xy);
    this.x[n] = screenX;
    this.y[n] = screenY;
    this.a[n] = yy * inverse;
    this.b[n] = -xy * inverse;
    this.c[n] = xx * inverse;
    this.opacity[n] = (share * alphas[i]) / 255;
    this.limit[n] = limit;
    this.reachY[n] = reachY;
    this.depth[n] = z;
    this.paint(n, this.asDepth ? null : chunk.rgb, i, tinted);
  }

  // Covariance of the image (xx, xy, yy) over (focal / depth)^2, with the Jacobian's slopes ju and jv.
  flatten(s, k, w, ju, jv) {
    const p0 = w[0] - ju * w[8];
    const p1 = w[1] - ju * w[9];
    const p2 = w[2] - ju * w[10];
    const q0 = w[4] - jv * w[8];
    const q1 = w[5] - jv * w[9];
    const q2 = w[6] - jv * w[10];
    const a0 = s[k] * p0 + s[k + 1] * p1 + s[k + 2] * p2;
    const a1 = s[k + 1] * p0 + s[k + 3] * p1 + s[k + 4] * p2;
    const a2 = s[k + 2] * p0 + s[k + 4] * p1 + s[k + 5] * p2;
    const b0 = s[k] * q0 + s[k + 1] * q1 + s[k + 2] * q2;
    const b1 = s[k + 1] * q0 + s[k + 3] * q1 + s[k + 4] * q2;
    const b2 = s[k + 2] * q0 + s[k + 4] * q1 + s[k + 5] * q2;
    this.flat[0] = p0 * a0 + p1 * a1 + p2 * a2;
    this.flat[1] = q0 * a0 + q1 * a1 + q2 * a2;
    this.flat[2] = q0 * b0 + q1 * b1 + q2 * b2;
  }

  paint(n, rgb, i, tinted) {
    if (!rgb) {
      this.red[n] = this.depth[n];
      this.green[n] = 1;
      this.blue[n] = 0;
      return;
    }
    const { tint, tintShare } = SPLAT_RULES,
      keep = tinted ? 1 - tintShare : 1,
      add = tinted ? tintShare : 0;
    this.red[n] = keep * rgb[3 * i] + add * tint[0];
    this.green[n] = keep * rgb[3 * i + 1] + add * tint[1];
    this.blue[n] = keep * rgb[3 * i + 2] + add * tint[2];
  }
}

// What of a picture's rows top .. bottom the projection needs to know.
function frameOf({ focal, near, width, height, sharp, lowPass }, top, bottom) {
  const middleX = width / 2 - 0.5;
  const middleY = height / 2 - 0.5;
  const right = (width / 2 + 2) / focal;
  const above = (top - middleY - 3) / focal;
  const below = (bottom - middleY + 3) / focal;
  return {
    focal,
    near,
    width,
    top,
    bottom,
    middleX,
    middleY,
    right,
    above,
    below,
    stretchX: Math.sqrt(1 + right * right),
    stretchY: Math.sqrt(1 + Math.max(above * above, below * below)),
    limitX: (SPLAT_RULES.slopeMargin * width) / focal,
    limitY: (SPLAT_RULES.slopeMargin * height) / focal,
    lowPass,
    faint: sharp ? 0 : Math.log(SPLAT_RULES.movingMinAlpha / SPLAT_RULES.minAlpha),
  };
}

// Rows of a matrix of world to camera, column-major, and where the camera is.
function cameraOf(v) {
  const rows = [v[0], v[4], v[8], v[12], v[1], v[5], v[9], v[13], v[2], v[6], v[10], v[14]];
  return { rows: Float64Array.from(rows), eye: eyeOf(v) };
}
