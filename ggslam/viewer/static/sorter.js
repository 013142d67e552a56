// SPDX-License-Identifier: Apache-2.0
// Puts the visible splats in order for WebGL, farthest first. Runs in a worker. Messages in: {add: {slot, centers, ids,
// radius}}, {remove: slot}, {marks: {slot, bytes}}, {displacement}, {states}, {sort: {view, slopes, near, serial}};
// out: {order: Uint32Array of slots, serial}.

class SplatSorter {
  constructor() {
    this.parts = new Map();
    this.displacement = null;
    this.states = new Uint8Array(65536).fill(SPLAT_RULES.visible);
    this.margin = 1.3; // of the frustum: the picture turns on while the order is made
    this.reserve(0);
  }

  reserve(count) {
    this.depths = new Float32Array(count);
    this.keys = new Uint32Array(this.depths.buffer);
    this.slots = new Uint32Array(count);
    this.rows = new Uint32Array(count);
    this.bins = new Uint16Array(count);
  }

  add({ slot, centers, ids, radius }) {
    this.parts.set(slot, { centers, ids, radius, marks: null });
    let count = 0;
    for (const part of this.parts.values()) count += part.ids.length;
    if (this.slots.length < count) this.reserve(count);
  }

  remove(slot) {
    this.parts.delete(slot);
  }

  setMarks({ slot, bytes }) {
    if (this.parts.has(slot)) this.parts.get(slot).marks = bytes;
  }

  sort({ view, slopes, near, serial }) {
    let count = 0;
    const moved = this.displacement && multiply(view, this.displacement.T);
    for (const [slot, part] of this.parts) count = this.collect(slot, part, view, moved, slopes, near, count);
    countingSort(this.keys, this.bins, this.rows, count);
    const order = new Uint32Array(count);
    for (let i = 0; i < count; i++) order[count - 1 - i] = this.slots[this.rows[i]];
    postMessage({ order, serial }, [order.buffer]);
  }

  // Appends the visible splats of a chunk; gives how many there are then.
  collect(slot, { centers, ids, marks, radius }, still, moved, [wide, tall], near, count) {
    const { states, displacement, margin } = this;
    for (let i = 0; i < ids.length; i++) {
      const mark = marks ? marks[i] : 0;
      if (!(states[ids[i]] & SPLAT_RULES.visible) || mark & SPLAT_RULES.gone) continue;
      const m = displacement && isDisplaced(displacement, ids[i], mark) ? moved : still;
      const x = centers[3 * i];
      const y = centers[3 * i + 1];
      const z = centers[3 * i + 2];
      const depth = m[2] * x + m[6] * y + m[10] * z + m[14];
      if (depth < near) continue;
      if (Math.abs(m[0] * x + m[4] * y + m[8] * z + m[12]) > margin * wide * depth + radius[i]) continue;
      if (Math.abs(m[1] * x + m[5] * y + m[9] * z + m[13]) > margin * tall * depth + radius[i]) continue;
      this.depths[count] = depth;
      this.slots[count++] = slot + i;
    }
    return count;
  }
}

function sortInWorker() {
  const sorter = new SplatSorter();
  const handlers = {
    add: (part) => sorter.add(part),
    remove: (slot) => sorter.remove(slot),
    marks: (marks) => sorter.setMarks(marks),
    displacement: (value) => (sorter.displacement = value),
    states: (value) => (sorter.states = value),
    sort: (wish) => sorter.sort(wish),
  };
  onmessage = (event) => {
    for (const [name, value] of Object.entries(event.data)) handlers[name](value);
  };
}

// order: rows 0 .. count - 1 by rising key. Keys are the bits of positive floats: bins of a share of the depth, 0.02 %
// where depths range from 5 cm to 100 m.
function countingSort(keys, bins, order, count) {
  let low = 0xffffffff;
  let high = 0;
  for (let i = 0; i < count; i++) {
    const key = keys[i];
    if (key < low) low = key;
    if (key > high) high = key;
  }
  let shift = 0;
  while ((high - low) >>> shift > 65535) shift++;
  const starts = new Uint32Array(65536);
  for (let i = 0; i < count; i++) starts[(bins[i] = (keys[i] - low) >>> shift)]++;
  for (let bin = 0, sum = 0; bin < 65536; bin++) {
    const n = starts[bin];
    starts[bin] = sum;
    sum += n;
  }
  for (let i = 0; i < count; i++) order[starts[bins[i]]++] = i;
}
