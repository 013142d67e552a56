// SPDX-License-Identifier: Apache-2.0
// The page: holds what is looked at and what is chosen, and tells its parts what changed.

const DEPTH_STOPS = [
  [48, 18, 59],
  [70, 107, 227],
  [40, 187, 235],
  [50, 241, 151],
  [162, 252, 60],
  [237, 207, 57],
  [250, 125, 32],
  [208, 48, 5],
  [122, 4, 2],
];
const BACKGROUNDS = { dark: [15, 17, 19], light: [236, 238, 241] };

class Viewer {
  constructor(source, scene) {
    Object.assign(this, {
      source,
      scene,
      unit: scene.objects?.length ? "objects" : "splats",
      mode: "set",
      seenOnly: true,
      brush: 26,
      coloring: "colour",
      frame: 0,
      total: 0,
    });
    this.hidden = new Set();
    this.steps = [];
    this.chosen = new Map();
    this.gone = new Map();
    this.depths = new WeakMap();
    this.listeners = new Map();
    this.space = document.getElementById("space");
    this.canvas = document.getElementById("map");
    this.overlay = document.getElementById("overlay");
    this.panels = document.getElementById("panels");
    this.shownLines = new Set(["path", "movers"]);
    this.camera = new OrbitCamera(this.canvas, scene.up || [0, -1, 0], scene.fov || 1, () => this.moved());
    this.map = new MapView(this.canvas, this.camera, { background: BACKGROUNDS[this.theme()] });
    this.edits = source.served ? new ServedEdits(this) : new LocalEdits(this);
    this.notes = new Notes(this, scene.annotations);
    this.film = new Film(this, scene.camera_keys);
    this.makeTools();
    this.makePanels();
    startKeyboard(this);
    this.applyTheme();
    this.camera.ondouble = (x, y) => {
      const hit = this.map.pick(x, y);
      if (hit) this.camera.lookAt(hit.point);
    };
    this.camera.onuser = () => {
      if (this.follow) {
        this.follow = false;
        this.emit("follow");
      }
      this.emit("user");
    };
    addEventListener("hashchange", () => {
      if (location.hash.slice(1) !== this.written) this.goToAddress();
    });
    this.map.ready.then(() => {
      document.getElementById("loading").hidden = true;
      window.ggslam.drawn = true;
    });
  }

  on(what, run) {
    (this.listeners.get(what) || this.listeners.set(what, []).get(what)).push(run);
  }
  emit(what, value) {
    for (const run of this.listeners.get(what) || []) run(value);
  }

  makeTools() {
    const bar = (this.tools = new ToolBar(this, document.getElementById("tools")));
    for (const [name, tool, words, key] of [
      ["look", new LookTool(this), "Look and pick", "1"],
      ["box", new BoxTool(this), "Box selection", "2"],
      ["lasso", new LassoTool(this), "Lasso selection", "3"],
      ["brush", new BrushTool(this), "Brush selection", "4"],
      ["sphere", new SphereTool(this), "Sphere selection", "5"],
      ["crop", new CropTool(this), "Crop box", "6"],
      ["move", new MoveTool(this), "Move what is selected", "7"],
      ["measure", new MeasureTool(this), "Measure", "8"],
      ["note", new NoteTool(this), "Note at a place", "9"],
    ])
      bar.offer(name, tool, words, key);
    bar.line();
    bar.action("undo", "Undo", "Ctrl+Z", () => this.undo());
    bar.action("redo", "Redo", "Ctrl+Shift+Z", () => this.redo());
    bar.action("link", "Copy a link to this view", "L", () => this.copyLink());
    bar.action("picture", "Save a picture", "P", () => this.savePicture());
  }

  makePanels() {
    for (const panel of [
      viewPanel,
      objectPanel,
      selectionPanel,
      framePanel,
      measurePanel,
      notePanel,
      filmPanel,
      editPanel,
      changePanel,
    ])
      panel(this);
    document.getElementById("theme").append(icon("sun"));
    document.getElementById("theme").onclick = () => this.nextTheme();
    document.getElementById("help").onclick = () => this.showKeys();
  }

  // --- the map

  async load() {
    for (const { id } of this.scene.chunks || []) this.map.setChunk(id, await this.source.splats(id));
    this.sceneChanged();
    this.emit("splats");
    this.emit("ready");
    this.emit("notes");
    this.emit("film");
    this.emit("edits");
    if (!this.goToAddress()) this.camera.look(Object.values(this.scene.views)[0]);
  }

  // After an edit, or news from a map that grows.
  async reload(splats = true) {
    const scene = await this.source.scene();
    if (scene.waiting) return;
    const first = !this.scene.chunks;
    this.scene = scene;
    this.camera.up = unit(scene.up);
    this.camera.fov = scene.fov;
    this.source.version = scene.version || this.source.version + 1;
    if (splats) for (const { id } of scene.chunks) this.map.setChunk(id, await this.source.splats(id));
    if (this.edits.take) this.edits.take(scene);
    this.notes.list = scene.annotations || this.notes.list;
    this.sceneChanged();
    if (splats) {
      this.color(this.coloring, false);
      this.applySelection();
      this.emit("splats");
    }
    this.emit("edits");
    this.emit("notes");
    if (first) this.camera.look(Object.values(scene.views)[0]);
  }

  sceneChanged() {
    document.getElementById("about").textContent = this.scene.about || "";
    document.getElementById("caption").textContent = this.scene.caption || "";
    const ids = new Set([0, ...this.scene.objects.map((o) => o.id)]);
    for (const id of this.hidden) if (!ids.has(id)) this.hidden.delete(id);
    this.emit("scene");
    this.drawLines();
    this.showHidden();
  }

  drawLines() {
    const { scene, map } = this,
      has = (name) => this.shownLines.has(name);
    scene.path.forEach((walk, k) =>
      has("path") ? map.setLines(`path ${k}`, segmentsOf(walk), [255, 176, 33], 2) : map.dropLines(`path ${k}`),
    );
    const keyframes = has("keyframes")
      ? scene.keyframes.flatMap((T) => [...frustumSegments(T, scene.camera, 0.05)])
      : [];
    if (keyframes.length) map.setLines("keyframes", Float32Array.from(keyframes), [110, 190, 255], 1);
    else map.dropLines("keyframes");
    (scene.movers || []).forEach((mover, k) => {
      const box = mover.boxes[String(scene.frames[this.frame]?.frame)],
        parts = [...segmentsOf(mover.way), ...(box ? boxSegments(box) : [])];
      if (has("movers")) map.setLines(`mover ${k}`, Float32Array.from(parts), mover.color, 2.5);
      else map.dropLines(`mover ${k}`);
    });
  }

  showLines(name, on) {
    on ? this.shownLines.add(name) : this.shownLines.delete(name);
    this.drawLines();
  }

  setFrame(k) {
    this.frame = k;
    const frame = this.scene.frames[k];
    this.showNow();
    if (this.coloring === "depth") this.color("depth", false);
    this.drawLines();
    this.remember();
  }

  // The camera of the frame that is looked at, unless the view is from there.
  showNow() {
    const T = this.scene.frames[this.frame]?.T;
    if (!T) return;
    if (length(minus([T[3], T[7], T[11]], this.camera.position)) < 0.15) this.map.dropLines("now");
    else this.map.setLines("now", frustumSegments(T, this.scene.camera, 0.1), [255, 235, 60], 2);
  }

  colorings() {
    const first = this.map.chunks.values().next().value,
      found = ["colour"];
    if (this.scene.objects.length) found.push("objects");
    if (first?.identity) found.push("identity");
    if (this.scene.frames.length) found.push("depth");
    return found;
  }

  color(name, tell = true) {
    this.coloring = this.colorings().includes(name) ? name : "colour";
    const palette = new Map(this.scene.objects.map((o) => [o.id, o.color]));
    for (const [chunk, splats] of this.map.chunks) this.map.setColors(chunk, this.colorsOf(splats, palette));
    if (tell) {
      this.emit("coloring");
      this.remember();
    }
  }

  colorsOf(splats, palette) {
    if (this.coloring === "colour") return null;
    if (this.coloring === "identity") return splats.identity;
    const rgb = new Uint8Array(3 * splats.count);
    if (this.coloring === "objects")
      for (let i = 0; i < splats.count; i++) rgb.set(palette.get(splats.ids[i]) || [110, 110, 110], 3 * i);
    else {
      const T = this.scene.frames[this.frame].T,
        from = [T[3], T[7], T[11]],
        far = new Float32Array(splats.count);
      for (let i = 0; i < splats.count; i++)
        far[i] = Math.hypot(
          splats.centers[3 * i] - from[0],
          splats.centers[3 * i + 1] - from[1],
          splats.centers[3 * i + 2] - from[2],
        );
      const sorted = far.slice().sort(),
        low = sorted[Math.floor(0.02 * far.length)] || 0,
        high = sorted[Math.floor(0.98 * far.length)] || 1;
      for (let i = 0; i < splats.count; i++) {
        const place = clamp((far[i] - low) / Math.max(high - low, 1e-9), 0, 1) * (DEPTH_STOPS.length - 1),
          k = Math.min(Math.floor(place), DEPTH_STOPS.length - 2);
        rgb.set(between(DEPTH_STOPS[k], DEPTH_STOPS[k + 1], place - k), 3 * i);
      }
    }
    return rgb;
  }

  nextColoring() {
    const all = this.colorings();
    this.color(all[(all.indexOf(this.coloring) + 1) % all.length]);
    this.say(`coloured by ${this.coloring}`);
  }

  // --- what is hidden and selected

  hide(ids, on) {
    for (const id of ids) on ? this.hidden.add(id) : this.hidden.delete(id);
    this.showHidden();
  }
  setHidden(ids) {
    this.hidden = new Set(ids);
    this.showHidden();
  }
  hideSelected() {
    const chosen = this.selectedObjects();
    if (chosen.length) {
      this.hide(chosen, true);
      this.select([]);
    } else this.say("objects can be hidden; splats can be deleted");
  }

  showHidden() {
    const chosen = new Set(this.selectedObjects());
    for (const id of [0, ...this.scene.objects.map((o) => o.id)])
      this.map.setObject(id, { visible: !this.hidden.has(id), selected: chosen.has(id) });
    this.emit("hidden");
    this.remember();
  }

  objectOf(id) {
    return this.scene.objects.find((o) => o.id === id);
  }

  // Ids, if whole objects are selected and nothing else.
  selectedObjects() {
    const ids = new Set();
    for (const { mode, shape } of this.steps) {
      if (shape.kind !== "objects") return [];
      if (mode === "set") ids.clear();
      if (mode === "intersect") {
        for (const id of ids) if (!shape.ids.includes(id)) ids.delete(id);
      } else for (const id of shape.ids) mode === "remove" ? ids.delete(id) : ids.add(id);
    }
    return [...ids].sort((a, b) => a - b);
  }

  // A shape follows the selection; exact: as it is, also where whole objects are selected.
  choose(mode, shape, exact = false) {
    let next = shape;
    if (!exact && this.unit === "objects" && shape.kind !== "objects" && this.scene.objects.length)
      next = { kind: "objects", ids: this.objectsIn(shape) };
    this.select(mode === "set" ? [{ mode, shape: next }] : [...this.steps, { mode, shape: next }]);
  }

  async chooseDrawn(mode, fill) {
    const shape = drawnShape(this, fill);
    if (shape.seen_only) this.depths.set(shape, await this.map.depthImage(shape.mask.width, shape.mask.height));
    this.choose(mode, shape);
  }

  // Objects of which a fair part is in a shape, or what is drawn covers a fair part of the shape.
  objectsIn(shape) {
    const inside = new Map(),
      all = new Map();
    for (const splats of this.map.chunks.values()) {
      const found = this.selected([{ mode: "set", shape }], splats);
      for (let i = 0; i < splats.count; i++) {
        const id = splats.ids[i];
        all.set(id, (all.get(id) || 0) + 1);
        if (found[i]) inside.set(id, (inside.get(id) || 0) + 1);
      }
    }
    const most = shape.seen_only ? 0.15 : 0.5;
    return [...inside]
      .filter(([id, count]) => id && !this.hidden.has(id) && count >= most * all.get(id))
      .map(([id]) => id)
      .sort((a, b) => a - b);
  }

  selected(steps, splats) {
    return selectedSplats(steps, splats, (shape) => this.depths.get(shape) || null);
  }

  select(steps) {
    const whole = steps.every(({ shape }) => shape.kind === "objects");
    this.steps = steps;
    if (whole && steps.length) {
      const ids = this.selectedObjects();
      this.steps = ids.length ? [{ mode: "set", shape: { kind: "objects", ids } }] : [];
    }
    this.applySelection();
    this.remember();
    if (this.source.served && this.scene.editable && this.steps.length && !this.selectedObjects().length)
      this.askServer();
  }

  invert() {
    this.select(
      this.steps.length
        ? [{ mode: "set", shape: { kind: "all" } }, ...this.minusSteps()]
        : [{ mode: "set", shape: { kind: "all" } }],
    );
  }

  // Steps that take away what the present ones select: exact for one step, else by splats as they were found here.
  minusSteps() {
    if (this.steps.length === 1) return [{ mode: "remove", shape: this.steps[0].shape }];
    const parts = this.steps.map((step) => ({ ...step }));
    if (parts.every(({ mode }) => mode === "set" || mode === "add"))
      return parts.map(({ shape }) => ({ mode: "remove", shape }));
    this.say("a selection of added and removed parts cannot be inverted");
    return parts.slice(0, 1).map(({ shape }) => ({ mode: "remove", shape }));
  }

  applySelection() {
    const objects = this.selectedObjects();
    this.total = 0;
    this.chosen = new Map();
    if (this.steps.length)
      for (const [chunk, splats] of this.map.chunks) {
        const found = this.selected(this.steps, splats),
          gone = this.gone.get(chunk);
        for (let i = 0; i < splats.count; i++) {
          if (found[i] && gone?.[i]) found[i] = 0;
          this.total += found[i];
        }
        this.chosen.set(chunk, found);
      }
    if (objects.length && this.source.served)
      this.total = objects.reduce(
        (sum, id) => sum + (id ? this.objectOf(id)?.gaussians || 0 : this.scene.unlabelled),
        0,
      );
    this.showMarks(objects.length > 0);
  }

  showMarks(objectsOnly) {
    for (const [chunk, splats] of this.map.chunks) {
      const found = objectsOnly ? null : this.chosen.get(chunk),
        gone = this.gone.get(chunk);
      if (!found && !gone) {
        this.map.setMarks(chunk, null);
        continue;
      }
      const marks = new Uint8Array(splats.count);
      for (let i = 0; i < splats.count; i++) marks[i] = (found?.[i] ? 1 : 0) | (gone?.[i] ? 2 : 0);
      this.map.setMarks(chunk, marks);
    }
    this.showHidden();
    this.drawSelectionBox();
    this.emit("selection");
  }

  // The program knows all Gaussians, and decides.
  async askServer() {
    const steps = this.steps;
    await this.try(async () => {
      const { count, bits } = await this.source.post("select", { selection: steps });
      if (steps !== this.steps) return;
      this.total = count;
      for (const [chunk, splats] of this.map.chunks) this.chosen.set(chunk, bitsOf(bits, splats.count));
      this.showMarks(false);
    });
  }

  drawSelectionBox() {
    const objects = this.selectedObjects()
      .filter(Boolean)
      .map((id) => this.objectOf(id))
      .filter(Boolean);
    if (objects.length)
      this.map.setLines("selected", Float32Array.from(objects.flatMap((o) => [...boxSegments(o)])), [255, 235, 60], 2);
    else this.map.dropLines("selected");
  }

  movedWho() {
    const objects = this.selectedObjects();
    return objects.length === 1 ? { object: objects[0] } : this.markAll();
  }

  markAll() {
    for (const [chunk, splats] of this.map.chunks)
      this.map.setMarks(
        chunk,
        Uint8Array.from({ length: splats.count }, (_, i) => (this.chosen.get(chunk)?.[i] ? 1 : 0)),
      );
    return { marks: true };
  }

  setGone(gone) {
    this.gone = gone;
    this.steps = [];
    this.applySelection();
  }

  wholeBox() {
    const axes = uprightAxes(this.scene.up),
      values = [[], [], []];
    for (const { count, centers } of this.map.chunks.values())
      for (let i = 0, step = Math.max(1, Math.floor(count / 20000)); i < count; i += step)
        axes.forEach((axis, k) =>
          values[k].push(axis[0] * centers[3 * i] + axis[1] * centers[3 * i + 1] + axis[2] * centers[3 * i + 2]),
        );
    const ranges = values.map((list) => {
      list.sort((a, b) => a - b);
      return [list[Math.floor(0.01 * list.length)], list[Math.floor(0.99 * list.length)]];
    });
    return {
      axes,
      size: ranges.map(([a, b]) => b - a),
      center: axes.reduce((p, axis, k) => add(p, axis, (ranges[k][0] + ranges[k][1]) / 2), [0, 0, 0]),
    };
  }

  lookAtSelected() {
    const box = boxOfSelected(this) || this.wholeBox(),
      way = unit(minus(box.center, this.camera.position)),
      far = clamp(1.4 * Math.max(...box.size), 0.4, 30);
    this.camera.glide({ position: add(box.center, way, -far), look_at: box.center, up: this.camera.up });
  }

  copyBox() {
    const box = boxOfSelected(this);
    if (box)
      this.copy(
        `middle ${box.center.map((v) => v.toFixed(3)).join(" ")} m, size ${box.size.map((v) => v.toFixed(3)).join(" ")} m`,
      );
  }

  saveSelection() {
    if (this.steps.length) download("selection.json", JSON.stringify(this.steps));
    else this.say("nothing is selected");
  }

  // --- edits

  async try(run) {
    try {
      return await run();
    } catch (error) {
      this.say(error.message, true);
      return undefined;
    }
  }

  async edit(values) {
    if (values.selection && !values.selection.length) {
      this.say("nothing is selected");
      return;
    }
    const text = await this.try(() => this.edits.edit(values));
    if (text === undefined) return;
    if (values.kind !== "rename" && values.kind !== "recolor") this.select([]);
    if (this.tools.name === "crop") this.tools.choose("look");
    this.say(text);
    this.emit("edits");
  }

  async undo() {
    const text = await this.try(() => this.edits.undo());
    if (text !== undefined) {
      this.select([]);
      this.say(text);
    }
    this.emit("edits");
  }
  async redo() {
    const text = await this.try(() => this.edits.redo());
    if (text !== undefined) {
      this.select([]);
      this.say(text);
    }
    this.emit("edits");
  }

  async save(target, inpaint) {
    this.saving = true;
    this.emit("edits");
    this.say("saving: the edits are done to the run's files");
    const text = await this.try(() => this.edits.save(target, inpaint));
    this.saving = false;
    this.emit("edits");
    if (text !== undefined) this.say(text);
  }

  // --- links, pictures, words

  moved() {
    if (this.map) {
      this.showNow();
      this.map.redraw();
    }
    this.redrawOverlay();
    this.remember();
  }

  remember() {
    if (this.remembering || !this.map) return;
    this.remembering = setTimeout(() => {
      this.remembering = 0;
      this.written = this.address();
      try {
        history.replaceState(
          null,
          "",
          `${location.pathname.startsWith("/") && this.source.served ? location.pathname : ""}#${this.written}`,
        );
      } catch {
        /* a page in a sandbox has no history */
      }
    }, 300);
  }

  address() {
    return addressOf({
      ...this.camera.state(),
      coloring: this.coloring,
      hidden: [...this.hidden],
      selected: this.selectedObjects(),
      frame: this.frame,
    });
  }

  goToAddress() {
    const state = stateOf(location.hash);
    if (!state) return false;
    this.color(state.coloring);
    this.setHidden(state.hidden.filter((id) => !id || this.objectOf(id)));
    const ids = state.selected.filter((id) => !id || this.objectOf(id));
    this.select(ids.length ? [{ mode: "set", shape: { kind: "objects", ids } }] : []);
    if (state.frame < this.scene.frames.length) {
      this.frame = state.frame;
      this.emit("scene");
    }
    this.camera.look(state);
    return true;
  }

  copyLink() {
    const link = new URL(location.href);
    link.hash = this.address();
    this.copy(link.href, "the link is copied");
  }

  async copy(text, said = "copied") {
    try {
      await navigator.clipboard.writeText(text);
      this.say(said);
    } catch {
      this.say(text);
    } // a page from disk may not copy
  }

  async savePicture() {
    const { camera, canvas } = this,
      W = canvas.clientWidth,
      H = canvas.clientHeight,
      factor = Math.max(1, 1920 / Math.max(W, H));
    if (!this.source.served || !this.scene.editable) {
      download("map.png", await this.map.screenshot());
      return;
    }
    await this.try(async () => {
      const [r, d, f] = camera.axes(),
        p = camera.position,
        T = [0, 1, 2].flatMap((k) => [r[k], d[k], f[k], p[k]]).concat(0, 0, 0, 1);
      const width = Math.round(W * factor),
        height = Math.round(H * factor);
      download(
        "map.png",
        await this.source.post("picture", {
          width,
          height,
          focal: camera.focal(width, height),
          T_world_camera: T,
          hidden: [...this.hidden],
        }),
      );
    });
  }

  say(text, failed = false) {
    const said = document.getElementById("said");
    said.textContent = text;
    said.classList.toggle("failed", failed);
    clearTimeout(this.quiet);
    this.quiet = setTimeout(
      () => {
        said.textContent = "";
        said.classList.remove("failed");
      },
      failed ? 12000 : 6000,
    );
  }

  showKeys() {
    const dialog = document.getElementById("keys");
    if (!dialog.children.length)
      dialog.append(
        make("h1", { textContent: "Keys" }),
        make(
          "dl",
          {},
          ...KEYS.flatMap(([key, words]) => [make("dt", { textContent: key }), make("dd", { textContent: words })]),
        ),
        make("form", { method: "dialog" }, make("button", { className: "main", textContent: "Close" })),
      );
    dialog.showModal();
  }

  // --- looks

  focal() {
    return this.camera.focal(this.canvas.clientWidth, this.canvas.clientHeight);
  }

  theme() {
    let wish = null;
    try {
      wish = localStorage.getItem("ggslam-theme");
    } catch {
      /* no storage for this page */
    }
    return wish === "light" || wish === "dark"
      ? wish
      : matchMedia("(prefers-color-scheme: light)").matches
        ? "light"
        : "dark";
  }

  nextTheme() {
    const next = document.documentElement.dataset.theme === "light" ? "dark" : "light";
    try {
      localStorage.setItem("ggslam-theme", next);
    } catch {
      /* it holds for this page */
    }
    this.applyTheme(next);
  }

  applyTheme(theme = this.theme()) {
    document.documentElement.dataset.theme = theme;
    this.map.setTheme({ background: BACKGROUNDS[theme] });
  }

  redrawOverlay() {
    if (this.overlaid || !this.tools) return;
    this.overlaid = requestAnimationFrame(() => {
      this.overlaid = 0;
      const labels = this.notes.labels(),
        dots = [],
        board = document.getElementById("labels");
      this.tools.current.redraw(labels, dots);
      for (const old of this.overlay.querySelectorAll(".dot")) old.remove();
      for (const point of dots) {
        const at = this.camera.project(point);
        if (at) this.overlay.append(draw("circle", { class: "dot", cx: at[0], cy: at[1], r: 4.5 }));
      }
      board.replaceChildren(
        ...labels
          .map(({ point, text, kind }) => {
            const at = this.camera.project(point);
            return at
              ? make("span", { className: kind || "", textContent: text, style: `left: ${at[0]}px; top: ${at[1]}px` })
              : null;
          })
          .filter(Boolean),
      );
    });
  }

  // --- a map that grows

  listen() {
    this.source.listen(
      async (news) => {
        this.source.version = news.version || this.source.version;
        if (news.text) {
          document.getElementById("about").textContent = news.text;
        }
        if (news.what.includes("splats") || news.what.includes("scene") || news.what.includes("path")) {
          if (this.reloading) {
            this.again = true;
            return;
          }
          this.reloading = true;
          do {
            this.again = false;
            await this.try(() => this.reload(true));
          } while (this.again);
          this.reloading = false;
        }
        if (news.T_world_camera && this.scene.live) this.followCamera(news.T_world_camera);
        this.emit("news", news);
      },
      (lost) => {
        if (lost !== this.lost) {
          this.lost = lost;
          this.say(lost ? "the program that serves this page is gone" : "", lost);
        }
      },
    );
  }

  followCamera(T) {
    this.map.setLines("now", frustumSegments(T, this.scene.camera, 0.12), [255, 235, 60], 2);
    if (!this.follow) return;
    const forward = [T[2], T[6], T[10]],
      up = [-T[1], -T[5], -T[9]],
      p = [T[3], T[7], T[11]];
    this.camera.glide({ position: add(add(p, forward, -0.8), up, 0.4), look_at: add(p, forward, 2), up }, 0.9);
  }
}

async function startPage() {
  const inline = JSON.parse(document.getElementById("scene").textContent),
    source = inline ? new FileSource(inline, document.getElementById("splats").textContent) : new ServerSource();
  const empty = {
    objects: [],
    views: {},
    path: [],
    keyframes: [],
    frames: [],
    movers: [],
    changes: [],
    camera: null,
    floor: {},
    up: [0, -1, 0],
    fov: 1,
    live: true,
    waiting: true,
  };
  const scene = await source.scene(),
    viewer = new Viewer(source, scene.waiting ? { ...empty, ...scene } : scene);
  source.version = scene.version || 0;
  window.ggslam = Object.assign(viewer, { drawn: false });
  if (scene.waiting) {
    document.getElementById("loading").textContent = scene.about;
    viewer.emit("scene");
  } else await viewer.load();
  viewer.listen();
}

startPage().catch((error) => {
  document.getElementById("loading").textContent = error.message;
  console.error(error);
});
