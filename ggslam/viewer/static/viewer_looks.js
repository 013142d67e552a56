// SPDX-License-Identifier: Apache-2.0
// Light and dark, and what is drawn over the map. A part of `Viewer`.

class ViewerLooks {
  inView(point) {
    const at = this.camera.project(point);
    const { clientWidth, clientHeight } = this.canvas;
    return !!at && at[0] > 0 && at[1] > 0 && at[0] < clientWidth && at[1] < clientHeight;
  }

  // What a pixel is wide at a point, in metres.
  metresPerPixel(point) {
    return Math.max(dot(minus(point, this.camera.position), this.camera.axes()[2]), this.camera.near) / this.focal();
  }

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
        dots = this.notes.list.map(({ point }) => point),
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
}
