// SPDX-License-Identifier: Apache-2.0
// Paints a band of a picture. Runs in a worker. Messages in: {addChunk: [chunk, splats]}, {removeChunk: [chunk]}, ...
// as the renderers' methods, and {start: [{serial, shot, top, bottom, strips, kind, least}]}; out, for each strip:
// {serial, top, bottom, values, last, milliseconds, drawn}. A newer job ends an older one after the strip that is being painted.

class BandPainter {
  constructor() {
    this.chunks = new Map();
    this.states = new Uint8Array(65536).fill(SPLAT_RULES.visible);
    this.displacement = null;
    this.job = null;
    this.projector = new SplatProjector();
    this.tiles = new TilePainter();
    this.turns = new MessageChannel(); // between strips, messages get their turn
    this.turns.port1.onmessage = () => this.strip();
  }

  addChunk(chunk, splats) {
    const shapes = splats.seen && new SeenShapes(splats.seen, splats.covariances);
    this.chunks.set(chunk, { ...splats, shapes, marks: null });
  }

  removeChunk(chunk) {
    this.chunks.delete(chunk);
  }

  setColors(chunk, rgb) {
    if (this.chunks.has(chunk)) this.chunks.get(chunk).rgb = rgb;
  }

  setMarks(chunk, marks) {
    if (this.chunks.has(chunk)) this.chunks.get(chunk).marks = marks;
  }

  setStates(states) {
    this.states = states;
  }

  displace(displacement) {
    this.displacement = displacement;
  }

  start(job) {
    const busy = this.job;
    this.job = job;
    if (!busy) this.strip();
  }

  prepare({ shot, top, bottom, kind }) {
    const { projector, states, displacement } = this;
    projector.project([...this.chunks.values()], states, displacement, shot, top, bottom, kind === "depth");
    this.tiles.bin(projector, shot.width, top, bottom);
  }

  strip() {
    if (!this.job) return;
    const job = this.job;
    const { serial, shot, top, bottom, strips, kind, least } = job;
    const start = performance.now();
    if (job.next === undefined) {
      job.next = top;
      job.milliseconds = 0;
      this.prepare(job);
    }
    const from = job.next;
    const to = Math.min(bottom, from + Math.max(TILE, Math.ceil((bottom - top) / strips / TILE) * TILE));
    const [values, finish] = kind === "depth" ? this.deep(shot, from, to) : this.colored(shot, from, to);
    this.tiles.paint(this.projector, shot.width, from, to, least, finish);
    job.next = to;
    job.milliseconds += performance.now() - start;
    const { milliseconds } = job;
    const drawn = this.projector.count;
    postMessage({ serial, top: from, bottom: to, values, last: to >= bottom, milliseconds, drawn }, [values.buffer]);
    if (to < bottom) this.turns.port2.postMessage(0);
    else this.job = null;
  }

  // Pixels of rows from .. to, and what stores a tile in them.
  colored({ width, background: [r, g, b] }, from, to) {
    const pixels = new Uint32Array(width * (to - from));
    const { light, red, green, blue } = this.tiles;
    const finish = (x, y, wide, tall) => {
      for (let row = 0; row < tall; row++)
        for (let column = 0, k = row * TILE, at = (y - from + row) * width + x; column < wide; column++, k++, at++) {
          const R = red[k] + light[k] * r + 0.5;
          const G = green[k] + light[k] * g + 0.5;
          const B = blue[k] + light[k] * b + 0.5;
          pixels[at] = 0xff000000 | ((B > 255 ? 255 : B) << 16) | ((G > 255 ? 255 : G) << 8) | (R > 255 ? 255 : R);
        }
    };
    return [pixels, finish];
  }

  // Depths of rows from .. to, and what stores a tile in them: red has depths, green their weights.
  deep({ width }, from, to) {
    const depths = new Float32Array(width * (to - from));
    const { red, green } = this.tiles;
    const finish = (x, y, wide, tall) => {
      for (let row = 0; row < tall; row++)
        for (let column = 0, k = row * TILE, at = (y - from + row) * width + x; column < wide; column++, k++, at++)
          if (green[k] > 0.5) depths[at] = red[k] / green[k];
    };
    return [depths, finish];
  }
}

function paintInWorker() {
  const painter = new BandPainter();
  onmessage = (event) => {
    for (const [name, values] of Object.entries(event.data)) painter[name](...values);
  };
}
