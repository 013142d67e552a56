// SPDX-License-Identifier: Apache-2.0
// The panel: its pieces, and the parts for view, frames and objects; see selection_panels.js and record_panels.js for the
// others. Each part is one function that makes its elements and keeps them true by listening to the viewer.

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
