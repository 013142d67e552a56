// SPDX-License-Identifier: Apache-2.0
// The map on the screen: what is drawn, when, and how sharp. Two renderers do the drawing: WebglRenderer where there is
// a GPU, ProcessorRenderer where there is none. Nothing is drawn while nothing changes.

class MapView {
  // canvas: gets the pointer and shows lines; the picture of the map is put beneath it. camera: {view() column-major
  // world to camera, focal(width, height), near}. options: {background: [r, g, b], renderer: "webgl" | "processor",
  // trained: focal lengths, pixels, of the cameras whose pictures taught the map}.
  constructor(canvas, camera, options = {}) {
    Object.assign(this, {
      canvas,
      camera,
      chunks: new Map(),
      marks: new Map(),
      colors: new Map(),
      background: options.background || [15, 17, 19],
      trained: options.trained,
    });
    this.states = new Uint8Array(65536).fill(SPLAT_RULES.visible);
    this.displacement = null;
    this.lines = new MapLines(canvas);
    this.movedAt = -Infinity;
    this.drawnAt = -Infinity;
    this.times = [];
    this.ready = new Promise((resolve) => {
      this.becameReady = resolve;
    });
    this.onrest = () => {}; // the camera has come to rest, and the picture is sharp
    this.use(this.start(options.renderer || new URLSearchParams(location.search).get("renderer")));
    new ResizeObserver(() => this.redraw()).observe(canvas);
  }

  start(wish) {
    const beneath = () => {
      const canvas = document.createElement("canvas");
      canvas.setAttribute("aria-hidden", "true");
      this.canvas.before(canvas);
      return canvas;
    };
    let canvas = beneath();
    if (wish !== "processor")
      try {
        return new WebglRenderer(canvas, wish === "webgl");
      } catch (error) {
        if (wish === "webgl") throw error;
      }
    canvas.remove();
    canvas = beneath(); // one that has no WebGL context
    return new ProcessorRenderer(canvas);
  }

  use(renderer) {
    this.renderer = renderer;
    this.mode = renderer.mode;
    this.resolution = new Resolution(renderer.least, Math.min(devicePixelRatio, renderer.most), renderer.wanted);
    renderer.onchange = () => this.request();
    renderer.onframe = (shot, complete) => this.shown(shot, complete);
    renderer.onlost = () => this.lose();
  }

  // The GPU is gone; the processor goes on.
  lose() {
    this.renderer.canvas.remove();
    this.use(this.start("processor"));
    this.describe(this.renderer);
    for (const [chunk, rgb] of this.colors) this.renderer.setColors(chunk, rgb);
    this.redraw();
  }

  // Tells a renderer, or painters, all that there is.
  describe(renderer) {
    for (const [chunk, splats] of this.chunks) renderer.addChunk(chunk, splats);
    for (const [chunk, bytes] of this.marks) renderer.setMarks(chunk, bytes);
    renderer.setStates(this.states.slice());
    renderer.displace(this.displacement);
  }

  // --- what is drawn

  // A chunk takes the place of one of the same name, and has no marks and no other colours.
  setChunk(chunk, splats) {
    this.chunks.set(chunk, splats);
    this.marks.delete(chunk);
    this.colors.delete(chunk);
    this.tell("addChunk", chunk, splats);
    this.redraw();
  }

  dropChunk(chunk) {
    if (this.chunks.delete(chunk)) {
      this.marks.delete(chunk);
      this.colors.delete(chunk);
      this.tell("removeChunk", chunk);
      this.redraw();
    }
  }

  setColors(chunk, rgb) {
    if (rgb) this.colors.set(chunk, rgb);
    else this.colors.delete(chunk);
    this.renderer.setColors(chunk, rgb || this.chunks.get(chunk).rgb);
    this.redraw();
  }

  setObject(id, { visible = true, selected = false }) {
    const state = (visible ? SPLAT_RULES.visible : 0) | (selected && id ? SPLAT_RULES.selected : 0);
    if (this.states[id] !== state) {
      this.states[id] = state;
      this.statesChanged = true;
      this.redraw();
    }
  }

  setMarks(chunk, bytes) {
    if (bytes) this.marks.set(chunk, bytes);
    else this.marks.delete(chunk);
    this.tell("setMarks", chunk, bytes);
    this.redraw();
  }

  displace(T, who = {}) {
    this.displacement = T && { T: Float32Array.from(T), object: who.object || 0, marks: !!who.marks };
    this.tell("displace", this.displacement);
    this.redraw();
  }

  setLines(name, segments, color, width = 2) {
    this.lines.set(name, segments, color, width);
    this.redraw();
  }

  dropLines(name) {
    this.lines.drop(name);
    this.redraw();
  }

  setTheme({ background }) {
    this.background = background;
    this.redraw();
  }

  // --- when

  // Draws soon. Without a GPU whatever changes counts as movement: a sharp picture takes a while.
  redraw() {
    if (this.mode === "processor") this.movedAt = performance.now();
    this.request();
  }

  request() {
    if (!this.waiting)
      this.waiting = requestAnimationFrame((now) => {
        this.waiting = 0;
        this.frame(now);
      });
  }

  frame(now) {
    if (!this.canvas.clientWidth || !this.canvas.clientHeight) return;
    const view = this.camera.view(),
      moved = !this.lastView || view.some((value, i) => value !== this.lastView[i]);
    if (moved) {
      this.movedAt = now;
      this.lastView = view;
    }
    const still = now - this.movedAt >= MapView.REST_MS;
    if (this.statesChanged) {
      this.statesChanged = false;
      this.tell("setStates", this.states.slice());
    }
    clearTimeout(this.rest);
    if (!still) this.rest = setTimeout(() => this.request(), MapView.REST_MS + 1);
    this.renderer.draw(this.shot(still ? this.resolution.most : this.resolution.scale, still));
  }

  shot(scale, sharp) {
    const width = Math.max(1, Math.round(this.canvas.clientWidth * scale)),
      height = Math.max(1, Math.round(this.canvas.clientHeight * scale));
    return {
      ...this.lens(width, height),
      view: this.camera.view(),
      near: this.camera.near,
      width,
      height,
      background: this.background,
      sharp,
    };
  }

  // What a picture's size makes of the camera.
  lens(width, height) {
    const focal = this.camera.focal(width, height);
    return { focal, lowPass: lowPassFor(focal, this.trained) };
  }

  // A picture is on the screen; complete: its splats are in order.
  shown(shot, complete) {
    const now = performance.now(),
      gap = now - this.drawnAt;
    this.drawnAt = now;
    this.lines.draw(shot);
    // After every movement comes a sharp picture, so that the time between two coarse ones is what one takes.
    if (!shot.sharp && (shot.milliseconds || this.wasMoving)) this.resolution.took(shot.milliseconds || gap);
    this.wasMoving = !shot.sharp;
    this.times.push(now);
    while (this.times[0] < now - 1000) this.times.shift();
    if (complete && this.chunks.size) this.becameReady();
    if (shot.sharp && this.restedAt !== this.movedAt) {
      this.restedAt = this.movedAt;
      this.onrest();
    }
  }

  get stats() {
    let splats = 0;
    for (const { count } of this.chunks.values()) splats += count;
    const times = this.times.filter((time) => time > performance.now() - 1000);
    return {
      frameMs: this.resolution.frameMs,
      framesPerSecond: times.length,
      splats,
      drawn: this.renderer.count,
      scale: this.resolution.scale,
    };
  }

  // --- what is where

  // x, y: CSS pixels from the canvas's upper left corner. See `pickSplat`.
  pick(x, y) {
    const width = this.canvas.clientWidth,
      height = this.canvas.clientHeight,
      lens = this.lens(width, height);
    const chunks = new Map(
      [...this.chunks].map(([chunk, splats]) => [chunk, { splats, marks: this.marks.get(chunk) }]),
    );
    const shot = { ...lens, view: this.camera.view(), near: this.camera.near, width, height };
    const ray = [(x - width / 2) / lens.focal, (y - height / 2) / lens.focal];
    return pickSplat(chunks, this.states, this.displacement, shot, ray);
  }

  // Expected depth of the surfaces of the present picture, Float32Array [height * width], metres along the optical
  // axis; 0 where more than half of the light is the background's.
  async depthImage(width, height) {
    const shot = { ...this.shot(1, true), width, height, ...this.lens(width, height) };
    return this.painters().depth(shot);
  }

  // Workers that paint; with a GPU they are started when a depth image is wanted first.
  painters() {
    if (this.renderer.pool) return this.renderer.pool;
    if (!this.pool) {
      this.pool = new PainterPool();
      this.describe(this.pool);
    }
    return this.pool;
  }

  // Tells the renderer, and the painters beside it if there are any.
  tell(change, ...values) {
    this.renderer[change](...values);
    this.pool?.[change](...values);
  }

  // The canvas as it is seen, lines too, as a PNG.
  async screenshot() {
    const shot = this.shot(this.resolution.most, true),
      picture = document.createElement("canvas");
    picture.width = shot.width;
    picture.height = shot.height;
    const context = picture.getContext("2d");
    await this.renderer.copyTo(context, shot);
    this.lines.draw(shot);
    if (this.canvas.width) context.drawImage(this.canvas, 0, 0, shot.width, shot.height);
    return new Promise((resolve) => picture.toBlob(resolve, "image/png"));
  }
}
MapView.REST_MS = 150; // after the last movement the picture becomes sharp
