// SPDX-License-Identifier: Apache-2.0
// The panel of what is selected: what can be done to it, moving it, and the box of a crop.

function selectionPanel(viewer) {
  let asked = false; // whether people said what is selected
  const unit = split(
    { objects: "objects", splats: "splats" },
    viewer.unit,
    (value) => {
      viewer.unit = value;
      asked = true;
    },
    "What is selected",
  );
  const mode = split(
    { set: "new", add: "add", remove: "less", intersect: "both" },
    viewer.mode,
    (value) => {
      viewer.mode = value;
    },
    "How a selection follows another",
  );
  const seen = make("input", {
    type: "checkbox",
    id: "seen",
    checked: viewer.seenOnly,
    onchange: () => {
      viewer.seenOnly = seen.checked;
    },
  });
  const brush = make("input", {
    type: "range",
    id: "brush",
    min: 4,
    max: 120,
    value: viewer.brush,
    oninput: () => {
      viewer.brush = Number(brush.value);
    },
  });
  const told = make("p", { className: "value", id: "chosen" }),
    color = make("input", { type: "color", value: "#3060c0", "aria-label": "New colour" });
  const name = make("input", { type: "text", placeholder: "name", "aria-label": "Name", maxLength: 200, id: "name" });
  const does = (words, kind, more = {}) =>
    button(words, () => viewer.edit({ kind, selection: viewer.steps, ...(more.values?.() || {}) }), {
      id: `do-${kind}`,
      title: more.title || "",
    });
  const hide = button("Hide", () => viewer.hideSelected(), { title: "H", id: "do-hide" }),
    remove = does("Delete", "remove", { title: "Delete" }),
    keep = does("Keep only", "keep", { title: "Deletes all else" });
  const recolor = does("Recolour", "recolor", { values: () => ({ color: color.value }) });
  const rename = button(
    "Rename",
    () => viewer.edit({ kind: "rename", object: viewer.selectedObjects()[0], name: name.value }),
    { id: "do-rename" },
  );
  const assign = button(
    "Make object",
    () => viewer.edit({ kind: "assign", selection: viewer.steps, object: "new", name: name.value }),
    { id: "do-assign" },
  );
  const copyBox = button("Copy box", () => viewer.copyBox(), { id: "do-copy", title: "Its middle and size as text" });
  const whose = make("select", { "aria-label": "Object to add to", id: "whose" }),
    give = button(
      "Add to",
      () =>
        viewer.edit({
          kind: "assign",
          selection: viewer.steps,
          object: whose.value === "none" ? "none" : Number(whose.value),
        }),
      { id: "do-give" },
    );
  const whole = part(
    viewer,
    "Selection",
    true,
    named("Of", unit),
    named("Next", mode),
    row(
      make("label", { htmlFor: "seen", textContent: "Seen only" }),
      seen,
      make("label", { htmlFor: "brush", textContent: "brush" }),
      brush,
    ),
    told,
    row(
      hide,
      remove,
      keep,
      button("Invert", () => viewer.invert(), { title: "Ctrl+I", id: "do-invert" }),
    ),
    row(name, rename, assign),
    row(give, whose),
    row(color, recolor, copyBox),
    row(
      button("Export PLY", () => viewer.exportObject(), { id: "do-export", title: "The object's Gaussians as a file" }),
      button("Save selection", () => viewer.saveSelection(), { title: "For `ggslam edit --remove @FILE`" }),
    ),
    movePanel(viewer),
    cropPanel(viewer),
  );
  let offered = ""; // by a selection, not by a person
  const update = () => {
    const { total } = viewer,
      objects = viewer.selectedObjects(),
      box = total ? boxOfSelected(viewer) : null,
      one = objects.length === 1 && viewer.objectOf(objects[0]);
    whole.count(total ? total.toLocaleString() : "");
    const size = one ? one.size : box?.size || [0, 0, 0];
    told.textContent = total
      ? `${one ? `${one.id} · ${one.name || "object"}: ` : ""}${total.toLocaleString()} Gaussians, box ${size.map(metres).join(" × ")}`
      : "nothing is selected";
    hide.disabled = !objects.length;
    remove.disabled = !total || !viewer.edits.can("remove");
    keep.disabled = !total || !viewer.edits.can("keep");
    recolor.disabled = assign.disabled = give.disabled = !total || !viewer.edits.can("recolor");
    document.getElementById("do-export").disabled = !one || !viewer.source.served;
    rename.disabled = !one || !viewer.edits.can("rename");
    copyBox.disabled = !total;
    if (document.activeElement !== name && (one || name.value === offered)) name.value = offered = one?.name || "";
    whose.replaceChildren(
      ...viewer.scene.objects.map((o) => new Option(`${o.id} · ${o.name || "object"}`, o.id)),
      new Option("no object", "none"),
    );
  };
  viewer.on("selection", update);
  viewer.on("scene", () => {
    if (!asked) unit.choose((viewer.unit = viewer.scene.objects.length ? "objects" : "splats"));
    update();
  });
  viewer.on("unit", () => unit.choose(viewer.unit));
  viewer.on("tool", () => {
    if (!["box", "lasso", "brush", "sphere"].includes(viewer.tools.name)) return;
    for (const choice of [told, unit]) choice.scrollIntoView({ block: "nearest" }); // what the tool goes by
  });
}

function movePanel(viewer) {
  const inputs = ["left-right", "near-far", "up", "turn °"].map((words) =>
    make("input", {
      type: "number",
      step: words === "turn °" ? 5 : 0.01,
      value: 0,
      "aria-label": `Move: ${words}`,
      title: words,
      className: "axis",
    }),
  );
  const tool = () => viewer.tools.tools.get("move").tool,
    whole = make(
      "div",
      { id: "moving", hidden: true },
      row(make("span", { className: "name", textContent: "Move by" }), ...inputs),
      row(
        button("Keep", () => tool().apply(), { className: "main", id: "do-move" }),
        button("Put back", () => viewer.tools.choose("look")),
      ),
    );
  inputs.forEach((input) => {
    input.onchange = () => tool().setNumbers(inputs.map((one) => Number(one.value) || 0));
  });
  const update = () => {
    const numbers = viewer.tools.name === "move" && tool().numbers();
    reveal(whole, numbers);
    if (numbers)
      numbers.forEach((value, k) => {
        if (document.activeElement !== inputs[k])
          inputs[k].value = value.toFixed(k === 3 ? 1 : 3).replace(/^-(0\.0+)$/, "$1");
      });
  };
  viewer.on("moved", update);
  viewer.on("tool", update);
  return whole;
}

function cropPanel(viewer) {
  const tool = () => viewer.tools.tools.get("crop").tool,
    sizes = [0, 1, 2].map((k) =>
      make("input", { type: "number", step: 0.05, min: 0.02, className: "axis", "aria-label": `Crop: size ${k + 1}` }),
    );
  const yaw = make("input", {
      type: "number",
      step: 5,
      value: 0,
      className: "axis",
      "aria-label": "Crop: turn in degrees",
    }),
    whole = make(
      "div",
      { id: "cropping", hidden: true },
      row(make("span", { className: "name", textContent: "Box m, °" }), ...sizes, yaw),
      row(
        button("Select inside", () => viewer.choose("set", tool().shape(), true), { id: "do-inside" }),
        button(
          "Keep inside",
          () => viewer.edit({ kind: "keep", selection: [{ mode: "set", shape: tool().shape() }] }),
          { className: "main", id: "do-crop" },
        ),
      ),
    );
  sizes.forEach((input, k) => {
    input.onchange = () => {
      const box = tool().box;
      tool().set({
        ...box,
        size: box.size.map((value, j) => (j === k ? Math.max(0.02, Number(input.value) || value) : value)),
      });
    };
  });
  yaw.onchange = () => tool().setYaw(Number(yaw.value) || 0);
  const update = () => {
    const box = viewer.tools.name === "crop" && tool().box;
    reveal(whole, box);
    if (box && document.activeElement !== yaw) yaw.value = tool().yaw;
    if (box)
      box.size.forEach((value, k) => {
        if (document.activeElement !== sizes[k]) sizes[k].value = value.toFixed(3);
      });
  };
  viewer.on("cropped", update);
  viewer.on("tool", update);
  return whole;
}
