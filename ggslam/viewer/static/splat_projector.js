// SPDX-License-Identifier: Apache-2.0
// Splats on the screen, nearest first, for the painter of tiles. Runs in workers.

class SplatProjector {
  constructor() {
    this.capacity = 0;
    this.count = 0;
    this.logarithms = Float64Array.from({ length: 256 }, (_, alpha) => (alpha ? Math.log(alpha) : -1)); // of 255 alpha
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

  // chunks: {count, centers, covariances, alphas, ids, rgb, marks, radius}; top, bottom: rows of the picture that are
  // wanted; asDepth: colours are (depth, 1, 0).
  project(chunks, states, displacement, shot, top, bottom, asDepth) {
    this.reserve(chunks.reduce((sum, chunk) => sum + chunk.count, 0));
    this.count = 0;
    const moved = displacement && multiply(shot.view, displacement.T);
    for (const chunk of chunks) this.projectChunk(chunk, states, displacement, moved, shot, top, bottom, asDepth);
    this.sort();
  }

  projectChunk(chunk, states, displacement, moved, { view, focal, near, width, height, sharp }, top, bottom, asDepth) {
    const { count, centers, covariances: s, alphas, ids, rgb, marks, radius, shapes } = chunk;
    const logarithms = this.logarithms;
    const middleX = width / 2 - 0.5,
      middleY = height / 2 - 0.5,
      lowPass = SPLAT_RULES.lowPass;
    const faint = sharp ? 0 : Math.log(SPLAT_RULES.movingMinAlpha / SPLAT_RULES.minAlpha);
    const limitX = (SPLAT_RULES.slopeMargin * width) / focal,
      limitY = (SPLAT_RULES.slopeMargin * height) / focal;
    const left = -(width / 2 + 2) / focal,
      right = -left,
      above = (top - middleY - 3) / focal,
      below = (bottom - middleY + 3) / focal;
    const stretchX = Math.sqrt(1 + right * right),
      stretchY = Math.sqrt(1 + Math.max(above * above, below * below));
    let n = this.count,
      eye = eyeOf(view),
      [v0, v4, v8, v12, v1, v5, v9, v13, v2, v6, v10, v14] = rowsOf(view),
      own = true;
    for (let i = 0; i < count; i++) {
      const id = ids[i],
        state = states[id],
        mark = marks ? marks[i] : 0;
      if (!(state & SPLAT_RULES.visible) || mark & SPLAT_RULES.gone) continue;
      if (displacement) {
        const wanted = !isDisplaced(displacement, id, mark);
        if (wanted !== own) {
          own = wanted;
          eye = eyeOf(own ? view : moved);
          [v0, v4, v8, v12, v1, v5, v9, v13, v2, v6, v10, v14] = rowsOf(own ? view : moved);
        }
      }
      const cx = centers[3 * i],
        cy = centers[3 * i + 1],
        cz = centers[3 * i + 2];
      const z = v2 * cx + v6 * cy + v10 * cz + v14;
      if (z < near) continue;
      const x = v0 * cx + v4 * cy + v8 * cz + v12,
        r = radius[i],
        rx = r * stretchX;
      if (x - right * z > rx || left * z - x > rx) continue;
      const y = v1 * cx + v5 * cy + v9 * cz + v13,
        ry = r * stretchY;
      if (y - below * z > ry || above * z - y > ry) continue;
      const inverse = 1 / z,
        u = x * inverse,
        v = y * inverse,
        scale = focal * inverse;
      const ju = -(u < -limitX ? -limitX : u > limitX ? limitX : u),
        jv = -(v < -limitY ? -limitY : v > limitY ? limitY : v);
      const p0 = v0 + ju * v2,
        p1 = v4 + ju * v6,
        p2 = v8 + ju * v10,
        q0 = v1 + jv * v2,
        q1 = v5 + jv * v6,
        q2 = v9 + jv * v10;
      let k = 6 * i,
        from = s,
        fade = 1;
      if (shapes) {
        fade = shapes.look(i, eye[0] - cx, eye[1] - cy, eye[2] - cz, r / 3.34);
        if (fade <= 0) continue;
        from = shapes.shape;
        k = 0;
      }
      const s0 = from[k],
        s1 = from[k + 1],
        s2 = from[k + 2],
        s3 = from[k + 3],
        s4 = from[k + 4],
        s5 = from[k + 5];
      const e0 = s0 * p0 + s1 * p1 + s2 * p2,
        e1 = s1 * p0 + s3 * p1 + s4 * p2,
        e2 = s2 * p0 + s4 * p1 + s5 * p2,
        square = scale * scale;
      const xx = square * (p0 * e0 + p1 * e1 + p2 * e2) + lowPass,
        xy = square * (q0 * e0 + q1 * e1 + q2 * e2);
      const yy =
        square *
          (q0 * (s0 * q0 + s1 * q1 + s2 * q2) +
            q1 * (s1 * q0 + s3 * q1 + s4 * q2) +
            q2 * (s2 * q0 + s4 * q1 + s5 * q2)) +
        lowPass;
      const limit = logarithms[alphas[i]] - faint + (fade < 1 ? Math.log(fade) : 0);
      if (!(limit > 0)) continue;
      const reachY = Math.sqrt(2 * limit * yy),
        sy = middleY + focal * v;
      if (sy + reachY < top || sy - reachY > bottom - 1) continue;
      const reachX = Math.sqrt(2 * limit * xx),
        sx = middleX + focal * u;
      if (sx + reachX < 0 || sx - reachX > width - 1) continue;
      const determinant = 1 / (xx * yy - xy * xy);
      this.x[n] = sx;
      this.y[n] = sy;
      this.a[n] = yy * determinant;
      this.b[n] = -xy * determinant;
      this.c[n] = xx * determinant;
      this.opacity[n] = (fade * alphas[i]) / 255;
      this.limit[n] = limit;
      this.reachY[n] = reachY;
      this.depth[n] = z;
      this.paint(n++, asDepth ? null : rgb, i, state & SPLAT_RULES.selected || mark & SPLAT_RULES.marked);
    }
    this.count = n;
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

  sort() {
    countingSort(this.depthBits, this.bins, this.order, this.count);
  }
}

function rowsOf(v) {
  return [v[0], v[4], v[8], v[12], v[1], v[5], v[9], v[13], v[2], v[6], v[10], v[14]];
}

// order: rows 0 .. count - 1 by rising key. Keys are the bits of positive floats: bins of a share of the depth, 0.02 %
// where depths range from 5 cm to 100 m.
function countingSort(keys, bins, order, count) {
  let low = 0xffffffff,
    high = 0;
  for (let i = 0; i < count; i++) {
    const key = keys[i];
    if (key < low) low = key;
    if (key > high) high = key;
  }
  let shift = 0;
  while ((high - low) >>> shift > 65535) shift++;
  const starts = new Uint32Array(65536);
  for (let i = 0; i < count; i++) starts[(bins[i] = (keys[i] - low) >>> shift)]++;
  for (let bin = 0, sum = 0; bin < 65536; bin++) {
    const n = starts[bin];
    starts[bin] = sum;
    sum += n;
  }
  for (let i = 0; i < count; i++) order[starts[bins[i]]++] = i;
}
