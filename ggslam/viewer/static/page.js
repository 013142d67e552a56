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
    this.map = new MapView(this.canvas, this.camera, {
      background: BACKGROUNDS[this.theme()],
      trained: scene.trained_focals,
    });
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
    const chunks = this.scene.chunks || [];
    this.loadedVersion = this.scene.version;
    if (chunks.length > 1) this.startLoader(chunks);
    else for (const { id } of chunks) this.map.setChunk(id, await this.source.splats(id));
    this.sceneChanged();
    this.emit("splats");
    this.emit("ready");
    this.emit("notes");
    this.emit("film");
    this.emit("edits");
    this.arrive();
  }

  // Goes to the view that the address names, or to the first one; from now on the address follows.
  arrive() {
    if (!this.goToAddress()) this.camera.look(Object.values(this.scene.views)[0]);
    this.loaded = true;
  }

  // A map in many parts: what is near is loaded finer, whenever the camera rests.
  startLoader(chunks) {
    const budget = this.map.mode === "webgl" ? 1000000 : 150000;
    this.loader = new ChunkLoader(this.map, new ChunkLevels(chunks, budget), (id, level) => this.source.splats(id, level));
    this.loader.onerror = (error) => this.say(error.message, true);
  }

  // After an edit, or news from a map that grows.
  async reload(splats = true) {
    const scene = await this.source.scene();
    if (scene.waiting) return;
    const first = !this.scene.chunks,
      grew = this.scene.live && !scene.live;
    this.scene = scene;
    if (grew && scene.objects.length) {
      this.unit = "objects"; // those that the run has found
      this.emit("unit");
    }
    this.camera.up = unit(scene.up);
    this.camera.fov = scene.fov;
    this.source.version = scene.version || this.source.version + 1;
    const fresh = splats && scene.version !== this.loadedVersion; // of an edit here the answer and the news both tell
    this.loadedVersion = scene.version;
    if (fresh && !this.loader) for (const { id } of scene.chunks) this.map.setChunk(id, await this.source.splats(id));
    if (this.edits.take) this.edits.take(scene);
    if (scene.keeps && !this.keeping) {
      this.notes.take(scene.annotations);
      this.film.kept(scene.camera_keys);
    }
    this.sceneChanged();
    if (fresh) {
      this.color(this.coloring, false);
      this.applySelection();
      this.emit("splats");
    }
    this.emit("edits");
    this.emit("notes");
    if (first) this.arrive();
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
}

for (const part of [ViewerColors, ViewerSelecting, ViewerEditing, ViewerSharing, ViewerLooks, ViewerGrowing])
  for (const name of Object.getOwnPropertyNames(part.prototype))
    if (name !== "constructor") Viewer.prototype[name] = part.prototype[name];

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
