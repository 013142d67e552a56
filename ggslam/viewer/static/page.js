// SPDX-License-Identifier: Apache-2.0
// The page: unpacks the splats, fills the list, connects the controls.

const element = (id) => document.getElementById(id);
const scene = JSON.parse(element("scene").textContent);

async function unpacked() {
  const packed = Uint8Array.from(atob(element("splats").textContent), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer()), n = scene.count;
  let place = 0;
  const column = (width) => bytes.subarray(place, place += n * width);
  const word = (part, i) => part[i] | part[n + i] << 8; // low bytes, then high bytes
  const axes = [0, 1, 2].map(() => column(2)), scales = column(3), turns = column(4), colors = column(3);
  const alphas = column(1), owners = column(2), identity = scene.identity ? column(3) : null;
  const centers = new Float32Array(3 * n), covariances = new Float32Array(6 * n), ids = new Uint16Array(n), rgb = new Uint8Array(3 * n);
  const pca = identity && new Uint8Array(3 * n);
  for (let i = 0; i < n; i++) {
    for (let k = 0; k < 3; k++) {
      centers[3 * i + k] = scene.low[k] + (scene.high[k] - scene.low[k]) * word(axes[k], i) / 65535;
      rgb[3 * i + k] = colors[k * n + i];
      if (pca) pca[3 * i + k] = identity[k * n + i];
    }
    const v = [0, 1, 2].map((k) => Math.exp(2 * (scene.scales[0] + (scene.scales[1] - scene.scales[0]) * scales[k * n + i] / 255)));
    let [w, x, y, z] = [0, 1, 2, 3].map((k) => turns[k * n + i] - 128);
    const length = Math.hypot(w, x, y, z) || 1; w /= length; x /= length; y /= length; z /= length;
    const R = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
      [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]];
    [[0, 0], [0, 1], [0, 2], [1, 1], [1, 2], [2, 2]].forEach(([a, b], k) => {
      covariances[6 * i + k] = R[a][0] * R[b][0] * v[0] + R[a][1] * R[b][1] * v[1] + R[a][2] * R[b][2] * v[2];
    });
    ids[i] = word(owners, i);
  }
  return { count: n, centers, covariances, alphas, ids, rgb, identity: pca };
}

function start(splats) {
  const canvas = document.querySelector("canvas"), objects = new Map(scene.objects.map((o) => [o.id, o]));
  const hidden = new Set(); let selected = 0, waiting = false;
  const redraw = () => { if (!waiting) { waiting = true; requestAnimationFrame(() => { waiting = false; renderer.draw(camera); }); } };
  const renderer = new SplatRenderer(canvas, splats, scene.path, redraw);
  const camera = new OrbitCamera(canvas, scene.up, scene.fov, redraw);

  const byObject = new Uint8Array(3 * splats.count);
  for (let i = 0; i < splats.count; i++) byObject.set(objects.get(splats.ids[i])?.color || [110, 110, 110], 3 * i);
  const colorings = { colour: splats.rgb };
  if (objects.size) colorings.objects = byObject;
  if (splats.identity) colorings["identity (PCA)"] = splats.identity;
  element("coloring").append(...Object.keys(colorings).map((name) => new Option(name)));
  element("coloring").onchange = (event) => { renderer.recolor(colorings[event.target.value]); redraw(); };
  for (const [name, view] of Object.entries(scene.views)) {
    const button = document.createElement("button"); button.textContent = name; button.onclick = () => camera.look(view);
    element("places").append(button);
  }

  const show = () => {
    for (const id of [0, ...objects.keys()]) renderer.setState(id, !hidden.has(id), selected && id === selected);
    for (const item of element("objects").children) {
      const id = Number(item.dataset.id);
      item.classList.toggle("selected", id === selected); item.classList.toggle("hidden", hidden.has(id));
      item.firstChild.checked = !hidden.has(id);
    }
    const chosen = objects.get(selected);
    element("said").textContent = chosen ? `${chosen.id} · ${chosen.name || "object"} · ${chosen.gaussians.toLocaleString()} Gaussians` : "";
    redraw();
  };
  const select = (id) => {
    selected = id; show();
    document.querySelector("li.selected")?.scrollIntoView({ block: "nearest" });
  };
  const line = (id, name, color, count) => {
    const item = document.createElement("li"), box = document.createElement("input"); item.dataset.id = id;
    box.type = "checkbox"; box.checked = true; box.onclick = (event) => { event.stopPropagation(); hidden.has(id) ? hidden.delete(id) : hidden.add(id); show(); };
    const parts = ["swatch", "name", "count"].map((kind) => { const part = document.createElement("span"); part.className = kind; return part; });
    parts[0].style.background = `rgb(${color})`; parts[1].textContent = name; parts[2].textContent = count.toLocaleString();
    item.append(box, ...parts); item.onclick = () => select(id === selected ? 0 : id);
    return item;
  };
  element("objects").append(...scene.objects.map((o) => line(o.id, `${o.id} · ${o.name || "object"}`, o.color, o.gaussians)));
  if (objects.size) element("objects").append(line(0, "everything else", [110, 110, 110], scene.unlabelled));
  else element("choose").style.display = "none";
  element("all").onclick = () => { hidden.clear(); show(); };
  element("none").onclick = () => { for (const id of [0, ...objects.keys()]) hidden.add(id); show(); };
  element("only").onclick = () => { if (selected) { for (const id of [0, ...objects.keys()]) hidden.add(id); hidden.delete(selected); show(); } };
  camera.onclick = (left, top) => select(renderer.pick(camera, left, top));

  const slider = element("frame"); slider.max = scene.frames.length - 1;
  const picture = () => { const frame = scene.frames[slider.value]; element("picture").src = frame.picture; element("picture").title = `frame ${frame.frame}`; return frame; };
  slider.oninput = () => camera.look(picture().view);
  element("about").textContent = scene.about;
  new ResizeObserver(redraw).observe(canvas);
  renderer.recolor(splats.rgb); picture(); camera.look(Object.values(scene.views)[0]); show();
  window.ggslam = { scene, select, renderer, camera };
}

unpacked().then(start).catch((error) => { element("said").textContent = String(error); console.error(error); });
