// SPDX-License-Identifier: Apache-2.0
// Splats of many chunks in a few textures. A chunk has whole rows of 1,024 splats; a slot is row * 1024 + column.

class SplatTextures {
  constructor(gl) {
    this.gl = gl;
    this.rows = 0;
    this.free = []; // [first row, rows] that nobody has, in their order
    this.most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    this.kept = new Map(); // first slot -> what is stored there: textures that grow are filled again
    this.states = this.texture();
    this.dirty = true;
    this.stateBytes = new Uint8Array(4 * 65536).fill(255);
    for (let i = 0; i < 65536; i++) this.stateBytes[4 * i + 1] = 0;
  }

  texture() {
    const gl = this.gl,
      texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
      gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    return texture;
  }

  // First slot of a new chunk.
  add(splats) {
    const rows = Math.max(1, Math.ceil(splats.count / 1024)),
      first = this.take(rows);
    const words = new Uint32Array(rows * 3072 * 4),
      numbers = new Float32Array(words.buffer);
    const { count, centers: c, covariances: s, ids, seen } = splats;
    for (let i = 0; i < count; i++) {
      const k = 12 * i;
      numbers[k] = c[3 * i];
      numbers[k + 1] = c[3 * i + 1];
      numbers[k + 2] = c[3 * i + 2];
      words[k + 3] = ids[i];
      for (let j = 0; j < 6; j++) numbers[k + 4 + j] = s[6 * i + j];
      if (seen)
        words[k + 10] =
          (seen[4 * i] | (seen[4 * i + 1] << 8) | (seen[4 * i + 2] << 16) | (seen[4 * i + 3] << 24)) >>> 0;
      words[k + 11] = seen ? 1 : 0;
    }
    const kept = {
      rows,
      words,
      colors: new Uint8Array(rows * 4096),
      marks: new Uint8Array(rows * 1024),
      alphas: splats.alphas,
    };
    this.kept.set(1024 * first, kept);
    this.store("shapes", first, kept);
    this.store("marks", first, kept);
    this.setColors(1024 * first, splats.rgb);
    return 1024 * first;
  }

  remove(slot) {
    const { rows } = this.kept.get(slot);
    this.kept.delete(slot);
    this.free.push([slot / 1024, rows]);
    this.free.sort((a, b) => a[0] - b[0]);
    for (let i = this.free.length - 1; i > 0; i--) {
      const [before, after] = [this.free[i - 1], this.free[i]];
      if (before[0] + before[1] === after[0]) {
        before[1] += after[1];
        this.free.splice(i, 1);
      }
    }
  }

  setColors(slot, rgb) {
    const kept = this.kept.get(slot),
      { colors, alphas } = kept;
    for (let i = 0; i < alphas.length; i++) {
      colors[4 * i] = rgb[3 * i];
      colors[4 * i + 1] = rgb[3 * i + 1];
      colors[4 * i + 2] = rgb[3 * i + 2];
      colors[4 * i + 3] = alphas[i];
    }
    this.store("colors", slot / 1024, kept);
  }

  setMarks(slot, bytes) {
    const kept = this.kept.get(slot);
    if (bytes) kept.marks.set(bytes);
    else kept.marks.fill(0);
    this.store("marks", slot / 1024, kept);
  }

  setState(id, visible, selected) {
    this.stateBytes[4 * id] = visible ? 255 : 0;
    this.stateBytes[4 * id + 1] = selected ? 255 : 0;
    this.dirty = true;
  }

  take(rows) {
    let place = this.free.findIndex(([, n]) => n >= rows);
    if (place < 0) {
      this.grow(rows);
      place = this.free.findIndex(([, n]) => n >= rows);
    }
    const hole = this.free[place],
      first = hole[0];
    hole[0] += rows;
    hole[1] -= rows;
    if (!hole[1]) this.free.splice(place, 1);
    return first;
  }

  grow(rows) {
    const old = this.rows,
      gl = this.gl;
    this.rows = Math.min(this.most, Math.max(old + rows, Math.ceil(1.5 * old)));
    if (this.rows < old + rows)
      throw new Error(`This GPU holds ${(1024 * this.most).toLocaleString()} splats, and there are more.`);
    for (const [name, width, format] of [
      ["shapes", 3072, gl.RGBA32UI],
      ["colors", 1024, gl.RGBA8UI],
      ["marks", 1024, gl.R8UI],
    ]) {
      if (this[name]) gl.deleteTexture(this[name]);
      this[name] = this.texture();
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, this.rows);
    }
    this.free.push([old, this.rows - old]);
    for (const [slot, kept] of this.kept)
      for (const name of ["shapes", "colors", "marks"]) this.store(name, slot / 1024, kept);
  }

  store(name, first, kept) {
    const gl = this.gl;
    gl.bindTexture(gl.TEXTURE_2D, this[name]);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    const [width, format, type, values] = {
      shapes: [3072, gl.RGBA_INTEGER, gl.UNSIGNED_INT, kept.words],
      colors: [1024, gl.RGBA_INTEGER, gl.UNSIGNED_BYTE, kept.colors],
      marks: [1024, gl.RED_INTEGER, gl.UNSIGNED_BYTE, kept.marks],
    }[name];
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, first, width, kept.rows, format, type, values);
  }

  bind() {
    const gl = this.gl;
    ["shapes", "colors", "marks", "states"].forEach((name, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, this[name]);
    });
    if (this.dirty) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 256, 256, 0, gl.RGBA, gl.UNSIGNED_BYTE, this.stateBytes);
    this.dirty = false;
    gl.activeTexture(gl.TEXTURE0);
  }
}
