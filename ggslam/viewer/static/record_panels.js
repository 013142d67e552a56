// SPDX-License-Identifier: Apache-2.0
// The panels of what is kept: measures, notes, a film's keys, edits, and what changed between two visits.

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
