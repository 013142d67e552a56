// SPDX-License-Identifier: Apache-2.0
// The panel: view, frames, objects, selection, measuring, notes, film, edits, changes. Each part is one function that
// makes its elements and keeps them true by listening to the viewer.

const row = (...parts) => make("div", { className: "row" }, ...parts);
const button = (words, run, more = {}) => make("button", { type: "button", textContent: words, onclick: run, ...more });
const named = (words, ...parts) => {
  const id = (parts[0].id ||= `c${Math.random().toString(36).slice(2)}`);
  return row(make("label", { textContent: words, htmlFor: id }), ...parts);
};

function part(viewer, title, open, ...content) {
  const small = make("small"),
    whole = make("details", { open }, make("summary", {}, title, small), ...content);
  whole.count = (text) => {
    small.textContent = text;
  };
  viewer.panels.append(whole);
  return whole;
}

// Shows a piece of the panel while it is needed.
function reveal(piece, needed) {
  const was = piece.hidden;
  piece.hidden = !needed;
  if (!needed || !was) return;
  piece.closest("details").open = true;
  piece.scrollIntoView({ block: "nearest" });
}

function viewPanel(viewer) {
  const coloring = make("select", { id: "coloring", onchange: () => viewer.color(coloring.value) }),
    places = row(make("span", { className: "name", textContent: "Camera" }));
  places.classList.add("tight");
  const lines = row(make("span", { className: "name", textContent: "Show" }));
  for (const [name, words] of [
    ["path", "path"],
    ["keyframes", "keyframes"],
    ["movers", "movers"],
  ]) {
    const box = make("input", {
        type: "checkbox",
        checked: viewer.shownLines.has(name),
        onchange: () => viewer.showLines(name, box.checked),
      }),
      label = make("label", {}, box, ` ${words}`);
    if (name !== "movers" || viewer.scene.movers?.length) lines.append(label);
  }
  const follow = make("input", {
      type: "checkbox",
      id: "follow",
      onchange: () => {
        viewer.follow = follow.checked;
      },
    }),
    following = row(
      make("label", { htmlFor: "follow", textContent: "Follow" }),
      follow,
      make("span", { className: "soft", textContent: "the camera as it goes" }),
    );
  part(viewer, "View", true, named("Colour by", coloring), places, lines, following);
  viewer.on("scene", () => {
    coloring.replaceChildren(...viewer.colorings().map((name) => new Option(name)));
    coloring.value = viewer.coloring;
    places.replaceChildren(
      places.firstChild,
      ...Object.entries(viewer.scene.views).map(([name, view]) => button(name, () => viewer.camera.glide(view))),
      viewer.scene.frames.length
        ? button("Frame", () => viewer.camera.glide(viewer.scene.frames[viewer.frame].view), {
            title: "From where the frame was taken",
          })
        : "",
      button("Selected", () => viewer.lookAtSelected(), { title: "What is selected (F)" }),
    );
    following.hidden = !viewer.scene.live;
    viewer.follow = viewer.scene.live && follow.checked;
  });
  viewer.on("follow", () => {
    follow.checked = viewer.follow;
  });
  viewer.on("coloring", () => {
    coloring.value = viewer.coloring;
  });
}

function framePanel(viewer) {
  const slider = make("input", { type: "range", id: "frame", min: 0, step: 1, value: 0 }),
    picture = make("img", { id: "picture", alt: "recorded and rendered images of the frame" });
  const go = make("input", { type: "checkbox", id: "going", checked: true }),
    play = button("Play", () => playing()),
    sliding = row(make("label", { htmlFor: "frame", textContent: "Frame" }), slider, play),
    looking = row(
      make("label", { htmlFor: "going", textContent: "Look" }),
      go,
      make("span", { className: "soft", textContent: "from where it was taken" }),
    ),
    whole = part(viewer, "Frames", true, sliding, looking, picture);
  let timer = 0,
    waiting = 0;
  const show = (look) => {
    const frame = viewer.scene.frames[slider.value];
    if (!frame) return;
    whole.count(`frame ${frame.frame}`);
    viewer.setFrame(Number(slider.value));
    clearTimeout(waiting);
    waiting = setTimeout(
      () => {
        picture.src = viewer.source.picture(frame);
      },
      viewer.source.served ? 60 : 0,
    );
    if (look && go.checked) viewer.camera.look(frame.view);
  };
  const playing = (on = !timer) => {
    clearInterval(timer);
    timer = 0;
    play.textContent = on ? "Stop" : "Play";
    if (on)
      timer = setInterval(() => {
        slider.value = (Number(slider.value) + 1) % viewer.scene.frames.length;
        show(true);
      }, 250);
  };
  slider.oninput = () => {
    playing(false);
    show(true);
  };
  viewer.on("user", () => playing(false));
  viewer.on("scene", () => {
    whole.hidden = !viewer.scene.frames.length && !viewer.scene.live;
    sliding.hidden = looking.hidden = !viewer.scene.frames.length;
    slider.max = Math.max(0, viewer.scene.frames.length - 1);
    slider.value = viewer.frame;
    if (viewer.scene.frames.length) show(false);
  });
  viewer.on("splats", () => {
    if (viewer.source.served && viewer.scene.frames.length) show(false);
  });
  viewer.on("news", () => {
    if (viewer.scene.live) picture.src = `frame?number=0&version=${viewer.source.version}`;
  });
}

function objectPanel(viewer) {
  const search = make("input", {
      type: "search",
      placeholder: "name, #7, red ...",
      "aria-label": "Search objects",
      onkeydown: (event) => {
        if (event.key === "Enter") selectFound();
      },
    }),
    list = make("ul", { id: "objects", role: "listbox", "aria-label": "Objects", "aria-multiselectable": "true" });
  const ids = () => [0, ...viewer.scene.objects.map((o) => o.id)],
    whole = part(
      viewer,
      "Objects",
      true,
      row(
        search,
        button("Select found", () => selectFound()),
      ),
      row(
        make("span", { className: "name", textContent: "Show" }),
        button("All", () => viewer.setHidden([]), { id: "all" }),
        button("None", () => viewer.setHidden(ids()), { id: "none" }),
        button(
          "Only selected",
          () => {
            const chosen = viewer.selectedObjects();
            if (chosen.length) viewer.setHidden(ids().filter((id) => !chosen.includes(id)));
          },
          { id: "only" },
        ),
      ),
      list,
    );
  const objects = (viewer.objectList = new ObjectList(viewer, list, search));
  const selectFound = () => {
    const found = objects.found();
    viewer.choose("set", { kind: "objects", ids: found });
    if (!found.length) viewer.say("no object is called so, nor has this colour");
  };
  viewer.on("scene", () => {
    whole.hidden = !viewer.scene.objects.length;
    whole.count(String(viewer.scene.objects.length));
  });
}

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

function measurePanel(viewer) {
  const list = make("ol", { id: "measured" }),
    copy = button("Copy", () => viewer.copy(tool().lines().join("\n"))),
    tool = () => viewer.tools.tools.get("measure").tool;
  const whole = part(
    viewer,
    "Measure",
    false,
    list,
    row(
      copy,
      button("Clear", () => tool().escape()),
    ),
  );
  const update = () => {
    const lines = tool().lines();
    list.replaceChildren(
      ...lines.map((text) => make("li", {}, make("span", { className: "value", textContent: text }))),
    );
    copy.disabled = !lines.length;
    whole.count(lines.length > 1 ? lines[lines.length - 1].split(" (")[0] : "");
    if (lines.length) whole.open = true;
  };
  viewer.on("measured", update);
  viewer.on("ready", update);
}

function notePanel(viewer) {
  const list = make("ul", { id: "notes" }),
    whole = part(
      viewer,
      "Notes",
      false,
      list,
      row(
        button("Download", () =>
          download("annotations.json", JSON.stringify({ annotations: viewer.notes.list }, null, 1)),
        ),
      ),
    );
  viewer.on("searched", () => {
    const words = viewer.objectList.search.value.trim().toLowerCase().split(/\s+/);
    [...list.children].forEach((item, k) => {
      const text = (viewer.notes.list[k]?.text || "").toLowerCase();
      item.hidden = !words.every((word) => text.includes(word));
      if (words[0] && !item.hidden) whole.open = true;
    });
  });
  viewer.on("notes", () => {
    const writing = list.querySelector("input");
    if (writing && writing === document.activeElement && viewer.notes.editing >= 0) return; // shown when it is written
    whole.count(viewer.notes.list.length ? String(viewer.notes.list.length) : "");
    list.replaceChildren(
      ...viewer.notes.list.map(({ text }, k) => {
        if (viewer.notes.editing !== k)
          return make(
            "li",
            {
              tabIndex: 0,
              onclick: () => viewer.notes.go(k),
              onkeydown: (event) => {
                if (event.key === "Enter") viewer.notes.go(k);
              },
            },
            make("span", { className: "label", textContent: text || "note", title: text }),
            button(
              "✎",
              (event) => {
                event.stopPropagation();
                viewer.notes.editing = k;
                viewer.emit("notes");
              },
              { "aria-label": "Edit note" },
            ),
            button(
              "×",
              (event) => {
                event.stopPropagation();
                viewer.notes.remove(k);
              },
              { "aria-label": "Delete note" },
            ),
          );
        const input = make("input", {
          type: "text",
          value: text,
          maxLength: 2000,
          className: "grow",
          "aria-label": "Text of the note",
          onkeydown: (event) => {
            event.stopPropagation();
            if (event.key === "Enter" || event.key === "Escape") input.blur();
          },
          onblur: () => {
            if (viewer.notes.editing >= 0) viewer.notes.setText(viewer.notes.editing, input.value);
          },
        });
        setTimeout(() => input.focus());
        whole.open = true;
        return make("li", {}, input);
      }),
    );
  });
}

function filmPanel(viewer) {
  const list = make("ol", { id: "film-keys" }),
    fps = make("input", { type: "number", min: 1, max: 120, value: 30, "aria-label": "Frames a second" });
  const file = make("input", {
    type: "file",
    accept: ".json",
    hidden: true,
    onchange: async () => {
      const text = await file.files[0].text();
      viewer.try(() => viewer.film.take(readKeys(text)));
      file.value = "";
    },
  });
  const how = make("p"),
    play = button("Play", () => viewer.film.play(), { id: "film-play" }),
    whole = part(
      viewer,
      "Film",
      false,
      list,
      row(
        button("Add this view", () => viewer.film.add(), { id: "film-add", title: "K" }),
        play,
      ),
      row(
        button("Download keys", () => download("keys.json", viewer.film.text(Number(fps.value) || 30)), {
          id: "film-save",
        }),
        button("Open keys", () => file.click()),
        make("label", {}, "fps ", fps),
        file,
      ),
      how,
    );
  viewer.on("film", () => {
    const { keys } = viewer.film;
    how.textContent = `ggslam render RUN --film fly.mp4 --path ${viewer.keeps() ? "keys" : "keys.json"} makes the film.`;
    play.textContent = viewer.film.running ? "Stop" : "Play";
    play.disabled = keys.length < 2;
    whole.count(keys.length ? String(keys.length) : "");
    list.replaceChildren(
      ...keys.map((key, k) =>
        make(
          "li",
          {
            tabIndex: 0,
            onclick: () => viewer.film.go(k),
            onkeydown: (event) => {
              if (event.key === "Enter" && event.target.tagName === "LI") viewer.film.go(k);
            },
          },
          make("input", {
            type: "number",
            step: 0.5,
            value: +key.time.toFixed(3),
            min: 0,
            "aria-label": `Time of key ${k + 1}`,
            style: "width: 70px",
            onclick: (event) => event.stopPropagation(),
            onchange: (event) => viewer.film.setTime(k, Number(event.target.value)),
          }),
          make("span", { className: "label", textContent: `s · key ${k + 1}` }),
          button(
            "↑",
            (event) => {
              event.stopPropagation();
              viewer.film.swap(k, k - 1);
            },
            { "aria-label": `Key ${k + 1} earlier`, disabled: k === 0 },
          ),
          button(
            "×",
            (event) => {
              event.stopPropagation();
              viewer.film.remove(k);
            },
            { "aria-label": `Delete key ${k + 1}` },
          ),
        ),
      ),
    );
  });
}

function editPanel(viewer) {
  const progress = make("progress", { hidden: true, "aria-label": "saving" });
  const list = make("ol", { id: "edits" }),
    target = make("input", { type: "text", id: "target", value: viewer.scene.target || "", maxLength: 200 }),
    inpaint = make("input", { type: "checkbox", id: "inpaint" });
  const undo = button("Undo", () => viewer.undo(), { title: "Ctrl+Z", id: "do-undo" }),
    redo = button("Redo", () => viewer.redo(), { title: "Ctrl+Shift+Z", id: "do-redo" }),
    save = button("Save edited run", () => viewer.save(target.value, inpaint.checked), {
      className: "main",
      id: "do-save",
    });
  const saved = make("p", { id: "saved", className: "value" });
  const saving = make(
    "div",
    {},
    named("Save as", target),
    row(
      make("label", { htmlFor: "inpaint", textContent: "Holes" }),
      inpaint,
      make("span", { className: "soft", textContent: "close those that objects leave" }),
    ),
    row(save, progress),
    saved,
  );
  const other = make("p", { textContent: "`ggslam view RUN` serves a page that moves, recolours and saves, too." }),
    whole = part(viewer, "Edits", false, list, row(undo, redo), saving, other);
  const update = () => {
    const { texts, redoCount } = viewer.edits;
    list.replaceChildren(
      ...texts.map((text) => make("li", {}, make("span", { className: "label", textContent: text, title: text }))),
    );
    undo.disabled = !texts.length;
    redo.disabled = !redoCount;
    save.disabled = !texts.length || viewer.saving;
    progress.hidden = !viewer.saving;
    saved.textContent = viewer.saved || "";
    saving.hidden = !viewer.scene.editable;
    other.hidden = !!viewer.source.served;
    whole.count(texts.length ? String(texts.length) : "");
    whole.hidden = viewer.scene.live;
    if (texts.length) whole.open = true;
    if (!target.value) target.value = viewer.scene.target || "";
  };
  viewer.on("edits", update);
  viewer.on("scene", update);
}

function changePanel(viewer) {
  const { changes } = viewer.scene,
    picture = make("img", { className: "picture", alt: "both visits", hidden: true });
  if (!changes?.length) return;
  const list = make(
    "ul",
    { id: "changes" },
    ...changes.map((change, k) =>
      make(
        "li",
        {
          tabIndex: 0,
          onclick: () => show(k),
          onkeydown: (event) => {
            if (event.key === "Enter") show(k);
          },
        },
        make("span", { className: "label", textContent: change.text, title: change.text }),
      ),
    ),
  );
  const show = (k) => {
    const change = changes[k];
    [...list.children].forEach((item, j) => item.classList.toggle("selected", j === k));
    for (const [name, color] of [
      ["old", [220, 30, 30]],
      ["new", [20, 160, 60]],
    ])
      if (change[name]) viewer.map.setLines(name, boxSegments(change[name]), color, 3);
      else viewer.map.dropLines(name);
    if (change.old && change.new)
      viewer.map.setLines("way", Float32Array.from([...change.old.center, ...change.new.center]), [220, 30, 30], 2);
    else viewer.map.dropLines("way");
    picture.hidden = !change.picture;
    picture.src = change.picture || "data:,";
    viewer.camera.glide(change.view);
  };
  part(viewer, "What changed", true, list, picture).count(String(changes.length));
}
