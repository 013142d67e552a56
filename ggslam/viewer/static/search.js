// SPDX-License-Identifier: Apache-2.0
// Finding objects and notes: by name, by id (#7), by the colour that they have (red).

const COLOR_WORDS = {
  red: [0, 0.5],
  orange: [28, 0.5],
  yellow: [52, 0.5],
  green: [120, 0.5],
  cyan: [180, 0.5],
  blue: [220, 0.5],
  purple: [280, 0.5],
  pink: [325, 0.5],
};

// The word for a colour, rgb 0 to 255: one of the eight above, or black, white, grey, brown.
function colorWord([r, g, b]) {
  const most = Math.max(r, g, b),
    least = Math.min(r, g, b),
    light = (most + least) / 510,
    spread = most - least;
  if (most < 45) return "black";
  if (spread < 28 || spread / Math.max(most, 1) < 0.14) return light > 0.78 ? "white" : light < 0.16 ? "black" : "grey";
  const hue =
    (60 * (most === r ? (g - b) / spread : most === g ? 2 + (b - r) / spread : 4 + (r - g) / spread) + 360) % 360;
  if (hue > 12 && hue < 45 && most < 170) return "brown";
  let best = "red",
    nearest = 361;
  for (const [word, [of]] of Object.entries(COLOR_WORDS)) {
    const gap = Math.min(Math.abs(hue - of), 360 - Math.abs(hue - of));
    if (gap < nearest) {
      nearest = gap;
      best = word;
    }
  }
  return best;
}

// The mean colour of each object's splats, by id.
function meanColors(chunks) {
  const sums = new Map();
  for (const { count, ids, rgb, alphas } of chunks.values())
    for (let i = 0; i < count; i++) {
      const sum = sums.get(ids[i]) || sums.set(ids[i], [0, 0, 0, 0]).get(ids[i]),
        weight = alphas[i];
      sum[0] += weight * rgb[3 * i];
      sum[1] += weight * rgb[3 * i + 1];
      sum[2] += weight * rgb[3 * i + 2];
      sum[3] += weight;
    }
  return new Map([...sums].map(([id, sum]) => [id, sum.slice(0, 3).map((value) => value / Math.max(sum[3], 1))]));
}

// Whether an object {id, name} of a mean colour is meant by some words: all of them have to fit.
function fits(words, { id, name }, color) {
  const text = `${id} ${name || "object"}`.toLowerCase(),
    own = color ? colorWord(color) : "";
  return words
    .toLowerCase()
    .split(/\s+/)
    .filter(Boolean)
    .every((word) => {
      if (/^#\d+$/.test(word)) return Number(word.slice(1)) === id;
      return text.includes(word) || own === (word === "gray" ? "grey" : word);
    });
}
