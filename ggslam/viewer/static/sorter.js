// SPDX-License-Identifier: Apache-2.0
// The worker that puts the visible splats in order for WebGL, farthest first. Messages in: {add: {slot, centers, ids}},
// {remove: slot}, {marks: {slot, bytes}}, {displacement}, {states}, {sort: {view, slopes, near, serial}}; out:
// {order: Uint32Array of slots, serial}.

function sortSplats() {
  const BINS = 65536,
    MARGIN = 1.3; // of the frustum: the picture turns on while the order is made
  const parts = new Map();
  let displacement = null,
    states = new Uint8Array(65536).fill(SPLAT_RULES.visible);
  let keys = new Float32Array(0),
    slots = new Uint32Array(0),
    bins = new Uint16Array(0);

  const room = () => {
    let count = 0;
    for (const { ids } of parts.values()) count += ids.length;
    if (keys.length < count) {
      keys = new Float32Array(count);
      slots = new Uint32Array(count);
      bins = new Uint16Array(count);
    }
  };

  const visible = ({ view: v, slopes: [wide, tall], near }) => {
    let count = 0;
    const moved = displacement && multiply(v, displacement.T);
    for (const [slot, { centers, ids, marks, radius }] of parts) {
      for (let i = 0; i < ids.length; i++) {
        if (!(states[ids[i]] & SPLAT_RULES.visible) || (marks && marks[i] & SPLAT_RULES.gone)) continue;
        const m = displacement && isDisplaced(displacement, ids[i], marks ? marks[i] : 0) ? moved : v;
        const x = centers[3 * i],
          y = centers[3 * i + 1],
          z = centers[3 * i + 2],
          r = radius[i];
        const depth = m[2] * x + m[6] * y + m[10] * z + m[14];
        if (depth < near) continue;
        if (Math.abs(m[0] * x + m[4] * y + m[8] * z + m[12]) > MARGIN * wide * depth + r) continue;
        if (Math.abs(m[1] * x + m[5] * y + m[9] * z + m[13]) > MARGIN * tall * depth + r) continue;
        keys[count] = depth;
        slots[count++] = slot + i;
      }
    }
    return count;
  };

  const sorted = (count) => {
    let low = Infinity,
      high = 0;
    for (let i = 0; i < count; i++) {
      low = Math.min(low, keys[i]);
      high = Math.max(high, keys[i]);
    }
    // Steps in the logarithm of depth: an order within centimetres matters near by only.
    low = Math.log(low);
    const factor = (BINS - 1) / Math.max(Math.log(high) - low, 1e-9);
    const starts = new Uint32Array(BINS),
      order = new Uint32Array(count);
    for (let i = 0; i < count; i++) starts[(bins[i] = BINS - 1 - Math.floor((Math.log(keys[i]) - low) * factor))]++;
    for (let bin = 0, sum = 0; bin < BINS; bin++) {
      const n = starts[bin];
      starts[bin] = sum;
      sum += n;
    }
    for (let i = 0; i < count; i++) order[starts[bins[i]]++] = slots[i];
    return order;
  };

  const handlers = {
    add: ({ slot, centers, ids, radius }) => {
      parts.set(slot, { centers, ids, radius, marks: null });
      room();
    },
    remove: (slot) => parts.delete(slot),
    marks: ({ slot, bytes }) => {
      if (parts.has(slot)) parts.get(slot).marks = bytes;
    },
    displacement: (value) => {
      displacement = value;
    },
    states: (value) => {
      states = value;
    },
    sort: (wish) => {
      const order = sorted(visible(wish));
      postMessage({ order, serial: wish.serial }, [order.buffer]);
    },
  };
  onmessage = (event) => {
    for (const [name, value] of Object.entries(event.data)) handlers[name](value);
  };
}
