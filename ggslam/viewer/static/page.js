// SPDX-License-Identifier: Apache-2.0
// The page: unpacks the splats, fills the list, connects the controls.

const element = (id) => document.getElementById(id);
const scene = JSON.parse(element("scene").textContent);

function unpacked() {
  return unpackSplats(Uint8Array.from(atob(element("splats").textContent), (letter) => letter.charCodeAt(0)).buffer, scene);
}

function start(splats) {
  const canvas = document.querySelector("canvas"), objects = new Map(scene.objects.map((o) => [o.id, o]));
  const hidden = new Set(); let selected = 0;
  const redraw = () => map.redraw(), camera = new OrbitCamera(canvas, scene.up, scene.fov, redraw), map = new MapView(canvas, camera);
  map.setChunk("map", splats); scene.path.forEach((walk, i) => map.setLines(`path ${i}`, segmentsOf(walk), [255, 176, 33]));

  const byObject = new Uint8Array(3 * splats.count);
  for (let i = 0; i < splats.count; i++) byObject.set(objects.get(splats.ids[i])?.color || [110, 110, 110], 3 * i);
  const colorings = { colour: splats.rgb };
  if (objects.size) colorings.objects = byObject;
  if (splats.identity) colorings["identity (PCA)"] = splats.identity;
  element("coloring").append(...Object.keys(colorings).map((name) => new Option(name)));
  element("coloring").onchange = (event) => { map.setColors("map", colorings[event.target.value]); };
  for (const [name, view] of Object.entries(scene.views)) {
    const button = document.createElement("button"); button.textContent = name; button.onclick = () => camera.look(view);
    element("places").append(button);
  }

  const show = () => {
    for (const id of [0, ...objects.keys()]) map.setObject(id, { visible: !hidden.has(id), selected: id === selected });
    for (const item of element("objects").children) {
      const id = Number(item.dataset.id);
      item.classList.toggle("selected", id === selected); item.classList.toggle("hidden", hidden.has(id));
      item.firstChild.checked = !hidden.has(id);
    }
    const chosen = objects.get(selected);
    element("said").textContent = chosen ? `${chosen.id} · ${chosen.name || "object"} · ${chosen.gaussians.toLocaleString()} Gaussians` : "";
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
  camera.onclick = (left, top) => select(map.pick(left, top)?.id || 0);

  const slider = element("frame"); slider.max = scene.frames.length - 1;
  const picture = () => { const frame = scene.frames[slider.value]; element("picture").src = frame.picture; element("picture").title = `frame ${frame.frame}`; return frame; };
  slider.oninput = () => camera.look(picture().view);
  element("about").textContent = scene.about;
  picture(); camera.look(Object.values(scene.views)[0]); show();
  map.ready.then(() => { window.ggslam.drawn = true; });
  window.ggslam = { scene, select, map, camera };
}

unpacked().then(start).catch((error) => { element("said").textContent = String(error); console.error(error); });
