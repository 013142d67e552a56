// SPDX-License-Identifier: Apache-2.0
// What is hidden and what is selected. A part of `Viewer`.

class ViewerSelecting {
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
    this.leaveHidden(next);
    this.select(mode === "set" ? [{ mode, shape: next }] : [...this.steps, { mode, shape: next }]);
  }

  // What is hidden is not selected by a shape.
  leaveHidden(shape) {
    if (shape.kind !== "objects" && this.hidden.size) shape.hidden = [...this.hidden];
    return shape;
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
    this.select([...this.steps, { mode: "invert", shape: this.leaveHidden({ kind: "all" }) }]);
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

  // T: where the boxes are moved to, a rigid transform by rows.
  drawSelectionBox(T = null) {
    const objects = this.selectedObjects()
      .filter(Boolean)
      .map((id) => this.objectOf(id))
      .filter(Boolean);
    const turn = (v) => minus(movedBy(T, v), movedBy(T, [0, 0, 0]));
    const moved = (o) => (T ? { ...o, center: movedBy(T, o.center), axes: o.axes.map(turn) } : o);
    const corners = objects.flatMap((o) => [...boxSegments(moved(o))]);
    if (corners.length) this.map.setLines("selected", Float32Array.from(corners), [255, 235, 60], 2);
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

  exportObject() {
    const [id] = this.selectedObjects();
    make("a", { href: `export?object=${id}`, download: "" }).click();
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
}
