// Values under the pointer, and tables that sort by a click on a heading. The page is whole without.
(() => {
  const tip = document.createElement("div");
  tip.className = "tip";
  document.body.append(tip);
  const shown = (v) => (Math.abs(v) >= 1000 ? Math.round(v).toString() : Number(v.toPrecision(4)).toString());
  const points = (e) => e.tagName === "path"
    ? [...e.getAttribute("d").matchAll(/M([-\d.]+) ([-\d.]+)/g)].map((m) => [+m[1], +m[2]])
    : e.getAttribute("points").trim().split(" ").map((p) => p.split(",").map(Number));
  for (const plot of document.querySelectorAll("svg.plot")) {
    const [left, top, right, bottom, x0, x1, y0, y1] = plot.dataset.axes.split(" ").map(Number);
    const names = plot.dataset.names.split("\n");
    let curves = null;
    plot.addEventListener("pointermove", (event) => {
      curves ??= [...plot.querySelectorAll("[data-n]")].map((e) => [+e.dataset.n, points(e)]);
      const box = plot.getBoundingClientRect();
      const scale = plot.viewBox.baseVal.width / box.width;
      const px = (event.clientX - box.left) * scale, py = (event.clientY - box.top) * scale;
      if (px < left || px > right || py < top || py > bottom) { tip.style.display = "none"; return; }
      const near = new Map();
      for (const [n, list] of curves) for (const [x, y] of list) {
        const d = Math.abs(x - px) + 0.01 * Math.abs(y - py);
        if (d < 24 && (!near.has(n) || d < near.get(n)[0])) near.set(n, [d, x, y]);
      }
      if (!near.size) { tip.style.display = "none"; return; }
      const first = [...near.values()].sort((a, b) => a[0] - b[0])[0];
      const along = x0 + (x1 - x0) * (first[1] - left) / (right - left);
      const lines = [`${plot.dataset.x}: ${plot.dataset.x === "frame" ? Math.round(along) : shown(along)}`];
      for (const [n, [, x, y]] of near) {
        if (Math.abs(x - first[1]) > 3) continue;
        const value = y1 - (y1 - y0) * (y - top) / (bottom - top);
        lines.push(`${names[n]}: ${shown(Math.abs(value) < 1e-6 * (y1 - y0) ? 0 : value)}`);
      }
      tip.textContent = lines.join("\n");
      tip.style.display = "block";
      tip.style.left = Math.min(event.clientX + 14, innerWidth - tip.offsetWidth - 8) + "px";
      tip.style.top = Math.max(8, event.clientY - tip.offsetHeight - 12) + "px";
    });
    plot.addEventListener("pointerleave", () => { tip.style.display = "none"; });
  }
  for (const table of document.querySelectorAll("table.sorts")) {
    table.querySelectorAll("thead th").forEach((heading, column) => {
      heading.classList.add("sortable");
      heading.addEventListener("click", () => {
        const body = table.tBodies[0], up = heading.dataset.up !== "yes";
        heading.dataset.up = up ? "yes" : "no";
        const value = (row) => row.cells[column].textContent.trim();
        const order = (a, b) => {
          const p = parseFloat(value(a)), q = parseFloat(value(b));
          return isNaN(p) || isNaN(q) ? value(a).localeCompare(value(b)) : p - q;
        };
        [...body.rows].sort((a, b) => (up ? order(a, b) : order(b, a))).forEach((row) => body.append(row));
      });
    });
  }
})();
