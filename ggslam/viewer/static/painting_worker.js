// SPDX-License-Identifier: Apache-2.0
// A worker that paints a band of a picture. Messages in: {addChunk: [chunk, splats]}, {removeChunk: [chunk]}, ... as
// the renderers' methods, and {job: {serial, shot, top, bottom, strips, kind, least}}; out, for each strip: {serial, top,
// bottom, values, last, milliseconds}. A newer job ends an older one after the strip that is being painted.

function paintInWorker() {
  const chunks = new Map(),
    projector = new SplatProjector(),
    painter = new TilePainter();
  let states = new Uint8Array(65536).fill(SPLAT_RULES.visible),
    displacement = null,
    job = null;
  const turns = new MessageChannel();

  const colored = (width, from, to, background) => {
    const pixels = new Uint32Array(width * (to - from)),
      { light, red, green, blue } = painter,
      [r, g, b] = background;
    const finish = (x, y, wide, tall) => {
      for (let row = 0; row < tall; row++)
        for (let column = 0, k = row * TILE, at = (y - from + row) * width + x; column < wide; column++, k++, at++) {
          const t = light[k],
            R = red[k] + t * r + 0.5,
            G = green[k] + t * g + 0.5,
            B = blue[k] + t * b + 0.5;
          pixels[at] = 0xff000000 | ((B > 255 ? 255 : B) << 16) | ((G > 255 ? 255 : G) << 8) | (R > 255 ? 255 : R);
        }
    };
    return [pixels, finish];
  };

  const deep = (width, from, to) => {
    const depths = new Float32Array(width * (to - from)),
      { red, green } = painter;
    const finish = (x, y, wide, tall) => {
      for (let row = 0; row < tall; row++)
        for (let column = 0, k = row * TILE, at = (y - from + row) * width + x; column < wide; column++, k++, at++)
          if (green[k] > 0.5) depths[at] = red[k] / green[k];
    };
    return [depths, finish];
  };

  const prepare = () => {
    const { shot, top, bottom, kind } = job;
    projector.project([...chunks.values()], states, displacement, shot, top, bottom, kind === "depth");
    painter.bin(projector, shot.width, top, bottom);
  };

  const strip = () => {
    if (!job) return;
    const { serial, shot, top, bottom, strips, kind, least } = job,
      start = performance.now();
    if (job.next === undefined) {
      job.next = top;
      prepare();
    }
    const rows = Math.max(TILE, Math.ceil((bottom - top) / strips / TILE) * TILE),
      from = job.next,
      to = Math.min(bottom, from + rows);
    const [values, finish] =
      kind === "depth" ? deep(shot.width, from, to) : colored(shot.width, from, to, shot.background);
    painter.paint(projector, shot.width, from, to, least, finish);
    job.next = to;
    job.milliseconds = (job.milliseconds || 0) + performance.now() - start;
    postMessage(
      {
        serial,
        top: from,
        bottom: to,
        values,
        last: to >= bottom,
        milliseconds: job.milliseconds,
        drawn: projector.count,
      },
      [values.buffer],
    );
    if (to < bottom) turns.port2.postMessage(0);
    else job = null;
  };
  turns.port1.onmessage = strip;

  const handlers = {
    addChunk: (chunk, splats) => {
      const shapes = splats.seen && new SeenShapes(splats.seen, splats.covariances);
      chunks.set(chunk, { ...splats, shapes, marks: null });
    },
    removeChunk: (chunk) => chunks.delete(chunk),
    setColors: (chunk, rgb) => {
      if (chunks.has(chunk)) chunks.get(chunk).rgb = rgb;
    },
    setMarks: (chunk, marks) => {
      if (chunks.has(chunk)) chunks.get(chunk).marks = marks;
    },
    setStates: (value) => {
      states = value;
    },
    displace: (value) => {
      displacement = value;
    },
    job: (value) => {
      const waiting = job;
      job = value;
      if (!waiting) strip();
    },
  };
  onmessage = (event) => {
    for (const [name, values] of Object.entries(event.data)) handlers[name](...values);
  };
}
