// SPDX-License-Identifier: Apache-2.0
// Paints projected splats tile by tile, front to back, until a tile lets no more light through. Runs in workers.

const TILE = 16;

class TilePainter {
  constructor() {
    this.pairs = 0;
    this.room(1 << 16);
    const pixels = TILE * TILE;
    for (const name of ["light", "red", "green", "blue"]) this[name] = new Float64Array(pixels);
    // exp(-p) for p in 256ths from 0 on, looked up in the middle of each step; alpha errs by at most 1 / 512.
    this.falls = Float64Array.from({ length: 8 * FALL_STEPS }, (_, k) => Math.exp(-(k + 0.5) / FALL_STEPS));
  }

  room(pairs) {
    const grown = (old) => {
      const found = new Uint32Array(pairs);
      if (old) found.set(old);
      return found;
    };
    this.pairTile = grown(this.pairTile);
    this.pairSplat = grown(this.pairSplat);
    this.listed = new Uint32Array(pairs);
  }

  // Lists the splats of each tile of rows top .. bottom (multiples of TILE but for the last) of a picture.
  bin(splats, width, top, bottom) {
    const columns = Math.ceil(width / TILE),
      rows = Math.ceil((bottom - top) / TILE);
    this.columns = columns;
    this.top = top;
    this.starts = new Uint32Array(columns * rows + 1);
    this.pairs = 0;
    const { order, count, x, y, a, b, c, limit, reachY } = splats,
      starts = this.starts;
    for (let k = 0; k < count; k++) {
      const i = order[k],
        sx = x[i],
        sy = y[i],
        reach = reachY[i],
        A = a[i],
        B = b[i],
        C = c[i],
        bound = 2 * limit[i];
      const first = Math.max(0, Math.floor((sy - reach - top + 0.5) / TILE)),
        last = Math.min(rows - 1, Math.floor((sy + reach - top + 0.5) / TILE));
      const span = Math.sqrt((bound * C) / (A * C - B * B)),
        tipRight = (-B / C) * span; // widest, and at which height
      for (let row = first; row <= last; row++) {
        const low = Math.max(top + row * TILE - 0.5 - sy, -reach),
          high = Math.min(top + (row + 1) * TILE - 0.5 - sy, reach);
        let right, left;
        if (low <= tipRight && tipRight <= high) right = span;
        else right = ellipseEdge(A, B, C, bound, tipRight < low ? low : high, 1);
        if (low <= -tipRight && -tipRight <= high) left = -span;
        else left = ellipseEdge(A, B, C, bound, -tipRight < low ? low : high, -1);
        const from = Math.max(0, Math.floor((sx + left + 0.5) / TILE)),
          to = Math.min(columns - 1, Math.floor((sx + right + 0.5) / TILE));
        if (this.pairs + columns > this.pairTile.length) this.room(2 * this.pairTile.length + columns);
        for (let column = from; column <= to; column++) {
          const tile = row * columns + column;
          this.pairTile[this.pairs] = tile;
          this.pairSplat[this.pairs++] = i;
          starts[tile + 1]++;
        }
      }
    }
    for (let tile = 0; tile < columns * rows; tile++) starts[tile + 1] += starts[tile];
    const places = starts.slice(),
      { pairTile, pairSplat, listed } = this;
    for (let k = 0; k < this.pairs; k++) listed[places[pairTile[k]]++] = pairSplat[k];
  }

  // Calls finish(x, y, wide, tall, painter) for each tile of rows from .. to.
  paint(splats, width, from, to, least, finish) {
    for (let y = from; y < to; y += TILE)
      for (let column = 0; column < this.columns; column++) {
        const wide = Math.min(TILE, width - column * TILE),
          tall = Math.min(TILE, to - y);
        this.paintTile(splats, ((y - this.top) / TILE) * this.columns + column, column * TILE, y, wide, tall, least);
        finish(column * TILE, y, wide, tall);
      }
  }

  paintTile(splats, tile, left, top, wide, tall, least) {
    const { light, red, green, blue, falls, listed, starts } = this,
      { x, y, a, b, c, opacity, limit } = splats;
    light.fill(1);
    red.fill(0);
    green.fill(0);
    blue.fill(0);
    let open = wide * tall;
    for (let k = starts[tile], stop = starts[tile + 1]; k < stop && open > 0; k++) {
      const i = listed[k],
        A = a[i],
        B = b[i],
        C = c[i],
        bound = 2 * limit[i],
        alpha0 = Math.min(0.999, opacity[i]);
      const x0 = x[i] - left,
        y0 = y[i] - top,
        cr = splats.red[i],
        cg = splats.green[i],
        cb = splats.blue[i],
        inverse = 1 / A,
        half2 = 0.5 * A * FALL_STEPS;
      const reach = splats.reachY[i],
        first = y0 > reach ? Math.ceil(y0 - reach) | 0 : 0,
        end = Math.min(tall - 1, Math.floor(y0 + reach)) | 0;
      for (let row = first; row <= end; row++) {
        const dy = row - y0,
          shift = -B * dy * inverse,
          root = shift * shift - (C * dy * dy - bound) * inverse;
        if (root <= 0) continue;
        const half = Math.sqrt(root),
          middle = x0 + shift;
        if (middle + half < 0 || middle - half > wide - 1) continue;
        const from = middle > half ? Math.ceil(middle - half) | 0 : 0,
          to = middle + half < wide - 1 ? (middle + half) | 0 : wide - 1;
        const rest = 0.5 * FALL_STEPS * (C * dy * dy - A * shift * shift);
        for (let column = from, k = row * TILE + from; column <= to; column++, k++) {
          const before = light[k];
          if (before < least) continue;
          const dx = column - middle,
            p = half2 * dx * dx + rest;
          const weight = alpha0 * falls[p | 0] * before;
          light[k] = before - weight;
          red[k] += weight * cr;
          green[k] += weight * cg;
          blue[k] += weight * cb;
          if (before - weight < least) open--;
        }
      }
    }
  }
}

const FALL_STEPS = 256;

// How far right (side 1) or left (-1) the ellipse A x^2 + 2 B x y + C y^2 = bound reaches at a height.
function ellipseEdge(A, B, C, bound, y, side) {
  return (-B * y + side * Math.sqrt(Math.max(0, B * B * y * y - A * (C * y * y - bound)))) / A;
}
