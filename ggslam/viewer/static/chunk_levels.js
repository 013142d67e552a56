// SPDX-License-Identifier: Apache-2.0
// Which chunks of a large map are held, and how fine: what is near and in sight gets more of a budget of splats.

class ChunkLevels {
  // chunks: [{id, count, low [3], high [3], levels: number of levels, each a quarter of the one before, or the splats of
  // each, finest first}]; budget: splats.
  constructor(chunks, budget) {
    Object.assign(this, { chunks, budget, chosen: new Map() });
  }

  static counts({ levels, count }) {
    return Array.isArray(levels) ? levels : Array.from({ length: levels }, (_, level) => Math.ceil(count / 4 ** level));
  }

  // camera: see MapView; width, height: of the screen. Gives Map id -> level of the chunks that should be held.
  choose(camera, width, height) {
    const view = camera.view(),
      focal = camera.focal(width, height),
      slopes = [width / 2 / focal, height / 2 / focal];
    const seen = this.chunks.map((chunk) => this.look(chunk, view, slopes, camera.near));
    seen.sort((one, other) => this.gap(other, other.coarsest) - this.gap(one, one.coarsest));
    const kept = [];
    let left = this.budget;
    for (const place of seen) {
      // each at its coarsest first, as many as there is room for
      const count = place.levels[place.coarsest];
      if (count <= left) {
        left -= count;
        place.level = place.coarsest;
        kept.push(place);
      }
    }
    for (;;) {
      const next = this.worst(kept, left, focal);
      if (!next) break;
      left -= next.levels[next.level - 1] - next.levels[next.level];
      next.level--;
    }
    this.chosen = new Map(kept.map(({ chunk, level }) => [chunk.id, level]));
    return this.chosen;
  }

  // The chunk that gains most by one level more, if its splats lie farther apart than a pixel and fit in what is left.
  worst(kept, left, focal) {
    let best = null,
      most = 1 / focal;
    for (const place of kept) {
      if (!place.level) continue;
      const { levels } = place,
        held = this.chosen.get(place.chunk.id) < place.level ? ChunkLevels.LOYALTY : 1;
      const gap = held * this.gap(place, place.level);
      if (gap > most && levels[place.level - 1] - levels[place.level] <= left) {
        best = place;
        most = gap;
      }
    }
    return best;
  }

  // Angle between neighbouring splats of a level as they are seen.
  gap({ levels, size, distance, share }, level) {
    return (share * size) / Math.sqrt(Math.max(1, levels[level])) / distance;
  }

  look(chunk, v, slopes, near) {
    const { low, high } = chunk,
      levels = ChunkLevels.counts(chunk),
      middle = [0, 1, 2].map((k) => (low[k] + high[k]) / 2),
      eye = eyeOf(v);
    const size = Math.hypot(...[0, 1, 2].map((k) => high[k] - low[k]));
    const beside = Math.hypot(...[0, 1, 2].map((k) => Math.max(low[k] - eye[k], 0, eye[k] - high[k])));
    const [x, y, z] = [0, 1, 2].map(
      (row) => v[row] * middle[0] + v[row + 4] * middle[1] + v[row + 8] * middle[2] + v[row + 12],
    );
    const out = Math.max(Math.abs(x) - slopes[0] * z, Math.abs(y) - slopes[1] * z, near - z);
    const share = out > (size * Math.hypot(1, ...slopes)) / 2 ? ChunkLevels.UNSEEN : 1;
    return {
      chunk,
      levels,
      size,
      distance: Math.max(beside, size / 4, near),
      share,
      coarsest: levels.length - 1,
      level: levels.length - 1,
    };
  }
}
ChunkLevels.UNSEEN = 0.1; // weight of what is out of sight: it is there, coarsely, when the camera turns
ChunkLevels.LOYALTY = 1.25; // weight of a level that is held already: it stays while the camera moves a little

// Loads what ChunkLevels chooses into a map, a few at a time.
class ChunkLoader {
  // load: async (chunk id, level) -> splats. A chunk that has a `version` is loaded again when that changes.
  constructor(map, levels, load) {
    Object.assign(this, { map, levels, load, held: new Map(), busy: new Set(), onerror: () => {} });
  }

  // Call when the camera rests and when the list of chunks changes.
  update() {
    const { clientWidth, clientHeight } = this.map.canvas;
    this.wanted = this.levels.choose(this.map.camera, clientWidth || 1, clientHeight || 1);
    for (const id of this.held.keys())
      if (!this.wanted.has(id)) {
        this.held.delete(id);
        this.map.dropChunk(id);
      }
    this.fill();
  }

  state(id) {
    return `${this.wanted.get(id)} ${this.levels.chunks.find((chunk) => chunk.id === id)?.version}`;
  }

  // What is not there at all comes before what is there too coarsely.
  fill() {
    const missing = [...this.wanted.keys()].filter((id) => !this.busy.has(id) && this.held.get(id) !== this.state(id));
    missing.sort((one, other) => this.held.has(one) - this.held.has(other));
    for (const id of missing.slice(0, Math.max(0, ChunkLoader.AT_ONCE - this.busy.size))) this.fetch(id);
  }

  async fetch(id) {
    const state = this.state(id);
    this.busy.add(id);
    try {
      const splats = await this.load(id, this.wanted.get(id));
      if (this.wanted.has(id)) {
        this.held.set(id, state);
        this.map.setChunk(id, splats);
      }
    } catch (error) {
      this.held.set(id, state); // not again until something changes
      this.onerror(error);
    }
    this.busy.delete(id);
    this.fill();
  }
}
ChunkLoader.AT_ONCE = 3;
