// SPDX-License-Identifier: Apache-2.0
// The list of objects: what is there, hidden, selected; found by words.

class ObjectList {
  constructor(viewer, element, search) {
    this.viewer = viewer;
    this.element = element;
    this.search = search;
    this.items = new Map();
    search.addEventListener("input", () => this.filter());
    element.addEventListener("keydown", (event) => this.key(event));
    element.addEventListener("focusin", (event) => this.stopAt(event.target.closest("li")));
    viewer.on("scene", () => this.fill());
    viewer.on("hidden", () => this.mark());
    viewer.on("selection", () => this.mark());
    viewer.on("splats", () => {
      this.colors = null;
    });
  }

  fill() {
    const { objects, unlabelled } = this.viewer.scene,
      lines = objects.map((o) => this.line(o.id, `${o.id} · ${o.name || "object"}`, o.color, o.gaussians));
    if (objects.length) lines.push(this.line(0, "everything else", [110, 110, 110], unlabelled));
    this.items = new Map(lines.map((item) => [Number(item.dataset.id), item]));
    this.element.replaceChildren(...lines);
    this.filter();
    this.mark();
  }

  line(id, words, color, count) {
    const box = make("input", {
      type: "checkbox",
      checked: true,
      "aria-label": `show ${words}`,
      onclick: (event) => {
        event.stopPropagation();
        this.viewer.hide([id], !box.checked);
      },
    });
    const item = make(
      "li",
      { tabIndex: 0, role: "option", onclick: (event) => this.choose(id, event) },
      box,
      make("span", { className: "swatch", style: `background: rgb(${color})` }),
      make("span", { className: "label", textContent: words, title: words }),
      make("span", { className: "count", textContent: count.toLocaleString() }),
    );
    item.dataset.id = id;
    return item;
  }

  choose(id, event) {
    const one = this.viewer.selectedObjects(),
      mode = event.shiftKey || event.ctrlKey || event.metaKey ? (one.includes(id) ? "remove" : "add") : "set";
    if (mode === "set" && one.length === 1 && one[0] === id) this.viewer.select([]);
    else this.viewer.choose(mode, { kind: "objects", ids: [id] });
  }

  key(event) {
    const item = event.target.closest("li");
    if (!item || (event.target.tagName === "INPUT" && event.key === " ")) return;
    const visible = [...this.items.values()].filter((one) => !one.hidden),
      at = visible.indexOf(item);
    if (event.key === "Enter" || event.key === " ") this.choose(Number(item.dataset.id), event);
    else if (event.key === "ArrowDown") visible[at + 1]?.focus();
    else if (event.key === "ArrowUp") visible[at - 1]?.focus();
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  filter() {
    const words = this.search.value.trim(),
      { objects } = this.viewer.scene;
    this.colors ||= words && meanColors(this.viewer.map.chunks);
    for (const object of objects)
      this.items.get(object.id).hidden = words !== "" && !fits(words, object, this.colors?.get(object.id));
    if (this.items.has(0)) this.items.get(0).hidden = words !== "";
    const visible = [...this.items.values()].filter((one) => !one.hidden);
    this.stopAt(visible.find((one) => one.dataset.id === this.stop) || visible[0]);
    this.viewer.emit("searched");
  }

  // Tab stops at one line, arrows go on from there.
  stopAt(item) {
    if (!item) return;
    this.stop = item.dataset.id;
    for (const one of this.items.values()) one.tabIndex = one.firstChild.tabIndex = one === item ? 0 : -1;
  }

  found() {
    return [...this.items].filter(([id, item]) => id && !item.hidden).map(([id]) => id);
  }

  mark() {
    const chosen = new Set(this.viewer.selectedObjects());
    for (const [id, item] of this.items) {
      const hidden = this.viewer.hidden.has(id);
      item.classList.toggle("selected", chosen.has(id));
      item.classList.toggle("hidden", hidden);
      item.setAttribute("aria-selected", chosen.has(id));
      item.firstChild.checked = !hidden;
    }
    if (chosen.size === 1) this.items.get([...chosen][0])?.scrollIntoView({ block: "nearest" });
  }
}
