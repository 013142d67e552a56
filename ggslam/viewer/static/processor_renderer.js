// SPDX-License-Identifier: Apache-2.0
// Draws without a GPU: workers paint, coarse and quickly while something moves, sharp when all is still.

class ProcessorRenderer {
  constructor(canvas) {
    this.canvas = canvas;
    this.mode = "processor";
    this.onchange = () => {};
    this.onframe = () => {};
    this.context = canvas.getContext("2d", { alpha: false });
    this.coarse = document.createElement("canvas");
    this.pool = new PainterPool();
    this.busy = false;
    this.next = null;
    this.chunks = new Set();
    this.least = 0.2;
    this.most = 1.5;
    this.wanted = 45; // pixels per CSS pixel; milliseconds a picture
    for (const name of ["setColors", "setMarks", "setStates", "displace"])
      this[name] = (...values) => this.pool[name](...values);
  }

  get count() {
    return this.pool.drawn || 0;
  }

  addChunk(chunk, splats) {
    this.chunks.add(chunk);
    this.pool.addChunk(chunk, splats);
  }

  removeChunk(chunk) {
    this.chunks.delete(chunk);
    this.pool.removeChunk(chunk);
  }

  draw(shot) {
    this.latest = shot;
    if (this.busy) {
      this.next = shot;
      return;
    }
    if (shot.sharp) this.sharpen(shot);
    else this.sketch(shot);
  }

  // All bands of a coarse picture appear together.
  async sketch(shot) {
    this.busy = true;
    const start = performance.now(),
      strips = [],
      complete = this.chunks.size > 0;
    const whole = await this.pool.paint(shot, { onstrip: (strip) => strips.push(strip) });
    this.busy = false;
    if (whole) {
      this.resize(shot);
      for (const strip of strips) this.put(strip, shot);
      this.onframe({ ...shot, milliseconds: performance.now() - start }, complete);
    }
    const next = this.next || (whole ? null : shot);
    this.next = null;
    if (!next) return;
    await this.pool.rest();
    if (this.latest === next && !this.busy) this.draw(next);
  }

  // Sharp strips replace the coarse picture as they come.
  async sharpen(shot) {
    const start = performance.now();
    let first = true;
    const onstrip = (strip) => {
      if (first) this.stretch(shot);
      first = false;
      this.put(strip, shot);
    };
    if (await this.pool.paint(shot, { strips: 12, onstrip })) {
      this.sharpMs = performance.now() - start;
      this.onframe(shot, this.chunks.size > 0);
      return;
    }
    await this.pool.rest(); // a depth image came between
    if (this.latest === shot && !this.busy) this.sharpen(shot);
  }

  resize({ width, height }) {
    const canvas = this.canvas;
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
    }
  }

  stretch(shot) {
    const { canvas, coarse } = this;
    if (canvas.width === shot.width && canvas.height === shot.height) return;
    coarse.width = canvas.width;
    coarse.height = canvas.height;
    coarse.getContext("2d").drawImage(canvas, 0, 0);
    this.resize(shot);
    this.context.drawImage(coarse, 0, 0, shot.width, shot.height);
  }

  put({ top, bottom, values }, { width }, context = this.context) {
    context.putImageData(new ImageData(new Uint8ClampedArray(values.buffer), width, bottom - top), 0, top);
  }

  async copyTo(context, shot) {
    await this.pool.finish(shot, { onstrip: (strip) => this.put(strip, shot, context) });
  }
}
