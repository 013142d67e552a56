// SPDX-License-Identifier: Apache-2.0
// Elements of the page: made of words and attributes, never of HTML texts, for names are anybody's.

const SVG = "http://www.w3.org/2000/svg";

function make(name, attributes = {}, ...content) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (key in made && key !== "list" && key !== "role") made[key] = value;
    else made.setAttribute(key, value);
  }
  made.append(...content.filter((part) => part !== null && part !== undefined));
  return made;
}

function draw(name, attributes = {}) {
  return setAttributes(document.createElementNS(SVG, name), attributes);
}

function setAttributes(element, attributes) {
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  return element;
}

const ICONS = {
  look: ["M5 3l6 17 2.5-7L21 10.5z"],
  box: ["M4 5h16v14H4z"],
  lasso: ["M12 4c5 0 8 2.5 8 5.5S17 15 12 15s-8-2-8-5.5S7 4 12 4z", "M8 14c-2 2-1 4 1 5"],
  brush: ["M14 4l6 6-8 8-6-6z", "M6 12c-3 1-3 5-4 7 3 0 7 0 8-3"],
  sphere: ["M12 3a9 9 0 100 18 9 9 0 000-18z", "M3 12c3 3 15 3 18 0"],
  crop: ["M7 2v15h15", "M2 7h15v15"],
  move: ["M12 3v18M3 12h18", "M9 6l3-3 3 3M9 18l3 3 3-3M6 9l-3 3 3 3M18 9l3 3-3 3"],
  measure: ["M3 16L16 3l5 5L8 21z", "M7 12l2 2M10 9l3 3M13 6l2 2"],
  note: ["M12 21s7-6.5 7-12a7 7 0 10-14 0c0 5.5 7 12 7 12z", "M12 7v4M12 13v.5"],
  undo: ["M9 7L4 12l5 5", "M4 12h10a6 6 0 016 6"],
  redo: ["M15 7l5 5-5 5", "M20 12H10a6 6 0 00-6 6"],
  picture: ["M4 7h4l2-3h4l2 3h4v12H4z", "M12 10a3 3 0 100 6 3 3 0 000-6z"],
  link: ["M10 14a4 4 0 005.7 0l3-3a4 4 0 00-5.7-5.7l-1 1", "M14 10a4 4 0 00-5.7 0l-3 3a4 4 0 005.7 5.7l1-1"],
  sun: ["M12 8a4 4 0 100 8 4 4 0 000-8z", "M12 2v3M12 19v3M2 12h3M19 12h3M5 5l2 2M17 17l2 2M5 19l2-2M17 7l2-2"],
};

function icon(name) {
  const made = draw("svg", { class: "icon", viewBox: "0 0 24 24", "aria-hidden": "true" });
  made.append(...ICONS[name].map((d) => draw("path", { d })));
  return made;
}

// Buttons of which one is chosen. choices: {value: words}.
function split(choices, chosen, onchoose, label) {
  const whole = make("span", { className: "split", role: "group", "aria-label": label });
  const mark = (value) => {
    for (const button of whole.children) button.setAttribute("aria-pressed", button.dataset.value === value);
  };
  for (const [value, words] of Object.entries(choices)) {
    const button = make("button", {
      type: "button",
      textContent: words,
      onclick: () => {
        mark(value);
        onchoose(value);
      },
    });
    button.dataset.value = value;
    whole.append(button);
  }
  mark(chosen);
  whole.choose = mark;
  return whole;
}

function download(name, content, kind = "application/json") {
  const address = URL.createObjectURL(content instanceof Blob ? content : new Blob([content], { type: kind }));
  make("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 10000);
}
