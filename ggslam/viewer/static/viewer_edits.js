// SPDX-License-Identifier: Apache-2.0
// Edits of the map, and how they are saved. A part of `Viewer`.

class ViewerEditing {
  async try(run) {
    try {
      return await run();
    } catch (error) {
      this.say(error.message, true);
      return undefined;
    }
  }

  // Whether notes and keys of the film are kept beside the run.
  keeps() {
    return this.source.served && !!this.scene.keeps;
  }

  async keep(what, values) {
    this.keeping = (this.keeping || 0) + 1;
    await this.try(() => this.source.post(what, values, "PUT"));
    this.keeping--;
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
    this.saved = "";
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
    this.say("saving: the edits are done to the run's files", false, true);
    const text = await this.try(() => this.edits.save(target, inpaint));
    this.saving = false;
    this.saved = text || "";
    this.emit("edits");
    if (text !== undefined) this.say(text);
  }
}
