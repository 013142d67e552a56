// SPDX-License-Identifier: Apache-2.0
// Edits: done by the program that serves the page, or, in a page of one file, by hiding splats here.

class LocalEdits {
  constructor(viewer) {
    this.viewer = viewer;
    this.done = [];
    this.undone = [];
  }

  get texts() {
    return this.done.map((edit) => edit.text);
  }
  get redoCount() {
    return this.undone.length;
  }
  can(kind) {
    return kind === "remove" || kind === "keep";
  }

  async edit({ kind, selection }) {
    if (!this.can(kind)) throw new Error("this page cannot do that; `ggslam view RUN` serves one that can");
    const before = this.viewer.gone,
      next = new Map();
    let count = 0;
    for (const [chunk, splats] of this.viewer.map.chunks) {
      const chosen = this.viewer.selected(selection, splats),
        gone = (before.get(chunk) || new Uint8Array(splats.count)).slice();
      for (let i = 0; i < splats.count; i++)
        if (!gone[i] && chosen[i] === (kind === "remove" ? 1 : 0)) {
          gone[i] = 1;
          count++;
        }
      next.set(chunk, gone);
    }
    if (!count) throw new Error("nothing is selected");
    const splats = `${count.toLocaleString()} ${count === 1 ? "splat" : "splats"}`;
    const text = kind === "remove" ? `removed ${splats}` : `cropped: ${splats} removed`;
    this.done.push({ text, before, after: next });
    this.undone = [];
    this.viewer.setGone(next);
    return text;
  }

  async undo() {
    const edit = this.done.pop();
    if (!edit) throw new Error("there is no edit to take back");
    this.undone.push(edit);
    this.viewer.setGone(edit.before);
    return `taken back: ${edit.text}`;
  }

  async redo() {
    const edit = this.undone.pop();
    if (!edit) throw new Error("there is no edit to do again");
    this.done.push(edit);
    this.viewer.setGone(edit.after);
    return edit.text;
  }
}

class ServedEdits {
  constructor(viewer) {
    this.viewer = viewer;
    this.take(viewer.scene);
  }

  take({ edits, redo }) {
    this.texts = edits || [];
    this.redoCount = redo || 0;
  }
  can() {
    return this.viewer.scene.editable;
  }

  async ask(action, values) {
    const answer = await this.viewer.source.post(action, values);
    this.take(answer);
    await this.viewer.reload();
    return answer.text;
  }

  edit(values) {
    return this.ask("edit", values);
  }
  undo() {
    return this.ask("undo", {});
  }
  redo() {
    return this.ask("redo", {});
  }
  async save(target, inpaint) {
    return (await this.viewer.source.post("save", { target, inpaint })).text;
  }
}
