// SPDX-License-Identifier: Apache-2.0
// What is looked at, kept in the address, so that a link leads there.

const rounded = (numbers) => numbers.map((value) => +value.toFixed(4)).join(",");

// state: {position, look_at, up, near, coloring, hidden: [ids], selected: [ids], tool, frame} as the part after #.
function addressOf(state) {
  const parts = [
    ["p", rounded(state.position)],
    ["t", rounded(state.look_at)],
    ["u", rounded(state.up)],
  ];
  if (state.near !== 0.05) parts.push(["n", rounded([state.near])]);
  if (state.coloring !== "colour") parts.push(["c", state.coloring]);
  if (state.hidden.length) parts.push(["h", rangesOf(state.hidden)]);
  if (state.selected.length) parts.push(["s", rangesOf(state.selected)]);
  if (state.tool !== "look") parts.push(["m", state.tool]);
  if (state.frame) parts.push(["f", String(state.frame)]);
  return new URLSearchParams(parts).toString();
}

// The other way; null where there is no view in it. What is damaged is left out.
function stateOf(address) {
  const given = new URLSearchParams(address.replace(/^#/, "")),
    vector = (name) => {
      const numbers = (given.get(name) || "").split(",").map(Number);
      return numbers.length === 3 && numbers.every(Number.isFinite) ? numbers : null;
    };
  const position = vector("p"),
    look_at = vector("t"),
    up = vector("u");
  if (!position || !look_at || !up || length(up) < 1e-6 || length(minus(position, look_at)) < 1e-9) return null;
  const near = Number(given.get("n")),
    frame = Number(given.get("f"));
  return {
    position,
    look_at,
    up,
    near: near > 0 && near < 1e4 ? near : 0.05,
    coloring: given.get("c") || "colour",
    hidden: idsOf(given.get("h")),
    selected: idsOf(given.get("s")),
    tool: given.get("m") || "look",
    frame: Number.isInteger(frame) && frame > 0 ? frame : 0,
  };
}

function rangesOf(ids) {
  const sorted = [...new Set(ids)].sort((a, b) => a - b),
    found = [];
  for (const id of sorted) {
    const last = found[found.length - 1];
    last && last[1] === id - 1 ? (last[1] = id) : found.push([id, id]);
  }
  return found.map(([a, b]) => (a === b ? a : `${a}-${b}`)).join(",");
}

function idsOf(text) {
  const found = [];
  for (const part of (text || "").split(",")) {
    const match = /^(\d{1,5})(?:-(\d{1,5}))?$/.exec(part);
    if (match)
      for (let id = Number(match[1]); id <= Math.min(Number(match[2] || match[1]), 65535); id++) found.push(id);
  }
  return found;
}
