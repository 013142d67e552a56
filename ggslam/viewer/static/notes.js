// SPDX-License-Identifier: Apache-2.0
// Notes at places of the map: a click, a text, a pin. They are kept beside the run, or downloaded.

class NoteTool extends Tool {
  start() {
    this.viewer.say("click where the note belongs");
  }

  click(x, y) {
    const hit = this.viewer.map.pick(x, y);
    if (!hit) {
      this.viewer.say("there is no surface there");
      return;
    }
    this.viewer.notes.add({ point: hit.point.map((value) => +value.toFixed(4)), text: "" });
  }
}

class Notes {
  constructor(viewer, list) {
    this.viewer = viewer;
    this.list = list || [];
    this.editing = -1;
  }

  // What is kept now; a note that is being written stays.
  take(list) {
    const draft = this.list[this.editing];
    this.list = list;
    if (!draft) return;
    this.editing = list.findIndex(({ point }) => length(minus(point, draft.point)) < 1e-6);
    if (this.editing < 0) this.editing = list.push(draft) - 1;
  }

  add(note) {
    this.list.push(note);
    this.editing = this.list.length - 1;
    this.changed(false);
  }

  setText(k, text) {
    this.list[k].text = text.slice(0, 2000);
    this.editing = -1;
    this.changed();
  }

  remove(k) {
    this.list.splice(k, 1);
    this.editing = -1;
    this.changed();
  }

  go(k) {
    const { camera } = this.viewer,
      { point } = this.list[k],
      far = clamp(length(minus(point, camera.position)), 0.5, 2),
      way = unit(minus(point, camera.position));
    camera.glide({ ...camera.state(), position: add(point, way, -far), look_at: point, up: camera.up });
  }

  async changed(keep = true) {
    this.viewer.emit("notes");
    this.viewer.redrawOverlay();
    if (keep && this.viewer.keeps())
      await this.viewer.keep("annotations", { annotations: this.list.filter((_, k) => k !== this.editing) });
  }

  labels() {
    return this.list.map(({ point, text }) => ({ point, text: text || "note", kind: "pin" }));
  }
}
