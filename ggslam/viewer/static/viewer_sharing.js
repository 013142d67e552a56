// SPDX-License-Identifier: Apache-2.0
// Links to a view, pictures, and what is said to people. A part of `Viewer`.

class ViewerSharing {
  moved() {
    if (this.map) {
      this.showNow();
      this.map.redraw();
    }
    if (this.loader) {
      clearTimeout(this.resting);
      this.resting = setTimeout(() => this.loader.update(), 200);
    }
    this.redrawOverlay();
    this.remember();
  }

  remember() {
    if (this.remembering || !this.loaded) return;
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
      tool: this.tools.name,
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
    if (this.tools.tools.has(state.tool)) this.tools.choose(state.tool);
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

  // stays: until something else is said.
  say(text, failed = false, stays = false) {
    const said = document.getElementById("said");
    said.textContent = text;
    said.classList.toggle("failed", failed);
    clearTimeout(this.quiet);
    if (stays) return;
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
    dialog.scrollTop = 0; // the button at its end has the focus
  }
}
