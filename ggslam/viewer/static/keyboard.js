// SPDX-License-Identifier: Apache-2.0
// Keys: flying, tools, edits. Whoever types into a field is left alone.

const FLIGHT = {
  KeyW: "forward",
  KeyS: "back",
  KeyA: "left",
  KeyD: "right",
  KeyE: "up",
  KeyQ: "down",
  ArrowUp: "forward",
  ArrowDown: "back",
};
const KEYS = [
  ["drag, right-drag, wheel", "turn, shift, come nearer; two fingers and pinch"],
  ["double click", "look at a place"],
  ["W A S D, Q E, arrows", "fly; with Shift faster; left and right arrows turn"],
  ["1 to 9", "tools: look, box, lasso, brush, sphere, crop, move, measure, note"],
  ["Shift, Alt, Ctrl + click", "add to the selection, take from it, keep what is in both"],
  ["Enter", "on the map: the tool works in the middle of the view"],
  ["Space + drag", "turn while a tool is chosen"],
  ["Ctrl+A, Ctrl+I, Escape", "select all, invert, nothing"],
  ["H, U", "hide the selected objects, show all"],
  ["Delete", "delete what is selected"],
  ["Ctrl+Z, Ctrl+Shift+Z", "undo, redo"],
  ["F", "look at what is selected"],
  ["K", "a key for the film"],
  ["C", "the next colouring"],
  ["T", "light or dark"],
  ["L", "copy a link to this view"],
  ["P", "save a picture"],
  ["/", "search"],
  ["?", "these keys"],
];

function startKeyboard(viewer) {
  const typing = (event) =>
    /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName) && !/^(checkbox|range|color)$/.test(event.target.type);
  const plain = {
    h: () => viewer.hideSelected(),
    u: () => viewer.setHidden([]),
    f: () => viewer.lookAtSelected(),
    k: () => viewer.film.add(),
    c: () => viewer.nextColoring(),
    t: () => viewer.nextTheme(),
    l: () => viewer.copyLink(),
    p: () => viewer.savePicture(),
    "?": () => viewer.showKeys(),
    Delete: () => viewer.edit({ kind: "remove", selection: viewer.steps }),
    "/": () => {
      viewer.objectList.search.focus();
      viewer.objectList.search.select();
    },
    Backspace: () =>
      viewer.tools.name === "measure"
        ? viewer.tools.current.back()
        : viewer.edit({ kind: "remove", selection: viewer.steps }),
    Escape: () => {
      if (!viewer.tools.current.escape()) {
        if (viewer.steps.length) viewer.select([]);
        else viewer.tools.choose("look");
      }
    },
  };
  const control = {
    z: (event) => (event.shiftKey ? viewer.redo() : viewer.undo()),
    y: () => viewer.redo(),
    a: () => viewer.choose("set", { kind: "all" }, true),
    i: () => viewer.invert(),
  };
  addEventListener("keydown", (event) => {
    if (typing(event) && event.key === "Escape") event.target.blur();
    if (typing(event) || document.querySelector("dialog[open]")) return;
    const run =
      event.ctrlKey || event.metaKey
        ? control[event.key.toLowerCase()]
        : plain[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    const onMap = document.activeElement === viewer.canvas || document.activeElement === document.body;
    if (run && !event.repeat) {
      run(event);
      event.preventDefault();
      return;
    }
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "Enter" && document.activeElement === viewer.canvas) {
      viewer.tools.useMiddle(event);
      event.preventDefault();
      return;
    }
    if (event.code === "Space" && onMap) {
      viewer.spaceDown = true;
      event.preventDefault();
      return;
    }
    if (/^[1-9]$/.test(event.key) && viewer.tools.byKey(event.key)) {
      event.preventDefault();
      return;
    }
    if (event.code.startsWith("Arrow") && !onMap) return;
    if (event.code === "ArrowLeft" || event.code === "ArrowRight") {
      viewer.camera.turnHead(event.code === "ArrowLeft" ? 12 : -12, 0);
      event.preventDefault();
      return;
    }
    if (FLIGHT[event.code]) {
      viewer.camera.fly(FLIGHT[event.code], true, event.shiftKey);
      event.preventDefault();
    }
  });
  addEventListener("keyup", (event) => {
    if (event.code === "Space") viewer.spaceDown = false;
    if (FLIGHT[event.code]) viewer.camera.fly(FLIGHT[event.code], false, event.shiftKey);
  });
  addEventListener("blur", () => {
    viewer.spaceDown = false;
    for (const way of Object.values(FLIGHT)) viewer.camera.fly(way, false, false);
  });
}
