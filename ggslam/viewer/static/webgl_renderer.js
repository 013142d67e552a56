// SPDX-License-Identifier: Apache-2.0
// Draws splats with WebGL 2. A worker puts them in order; until its first answer nothing is drawn, and a new chunk is
// drawn from the first order that has it on.

class WebglRenderer {
  // Throws an Error where there is no GPU, unless it is forced.
  constructor(canvas, forced) {
    const gl = (this.gl = canvas.getContext("webgl2", {
      antialias: false,
      alpha: false,
      depth: false,
      preserveDrawingBuffer: false,
      powerPreference: "high-performance",
      failIfMajorPerformanceCaveat: !forced,
    }));
    if (!gl || (!forced && drawsInSoftware(gl))) throw new Error("This browser has no WebGL 2 with a GPU.");
    this.canvas = canvas;
    this.mode = "webgl";
    this.onchange = () => {};
    this.onframe = () => {};
    canvas.addEventListener("webglcontextlost", () => this.onlost());
    this.least = 0.3;
    this.most = 1.5; // pixels per CSS pixel
    this.slots = new Map();
    this.leaving = []; // chunk -> slot; [slot, serial of the first order without it]
    this.serial = 0;
    this.sorting = false;
    this.count = 0;
    this.wanted = true;
    this.sorted = false;
    this.displacement = null;
    this.program = buildProgram(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.places = Object.fromEntries(
      ["view", "displacement", "focal", "size", "near", "lowPass", "displaced", "shapes", "colors", "marks", "states"].map(
        (name) => [name, gl.getUniformLocation(this.program, name)],
      ),
    );
    this.textures = new SplatTextures(gl);
    this.buffers();
    this.worker = startWorker(sortInWorker, {}, SplatSorter, countingSort, isDisplaced, multiply);
    this.worker.onmessage = (event) => this.take(event.data);
  }

  buffers() {
    const gl = this.gl,
      corner = gl.getAttribLocation(this.program, "corner"),
      which = gl.getAttribLocation(this.program, "which");
    this.quad = gl.createVertexArray();
    gl.bindVertexArray(this.quad);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(corner);
    gl.vertexAttribPointer(corner, 2, gl.FLOAT, false, 0, 0);
    this.order = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.enableVertexAttribArray(which);
    gl.vertexAttribIPointer(which, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(which, 1);
  }

  addChunk(chunk, splats) {
    this.removeChunk(chunk);
    const slot = this.textures.add(splats),
      { centers, ids } = splats;
    this.slots.set(chunk, slot);
    this.wanted = true;
    this.worker.postMessage({ add: { slot, centers, ids, radius: radii(splats) } });
  }

  // The slots stay until an order without them has come.
  removeChunk(chunk) {
    const slot = this.slots.get(chunk);
    if (slot === undefined) return;
    this.slots.delete(chunk);
    this.leaving.push([slot, this.serial + 1]);
    this.wanted = true;
    this.worker.postMessage({ remove: slot });
  }

  setColors(chunk, rgb) {
    this.textures.setColors(this.slots.get(chunk), rgb);
  }

  setMarks(chunk, bytes) {
    const slot = this.slots.get(chunk);
    this.textures.setMarks(slot, bytes);
    this.worker.postMessage({ marks: { slot, bytes } });
    this.wanted = true;
  }

  setStates(states) {
    for (let id = 0; id < 65536; id++)
      this.textures.setState(id, states[id] & SPLAT_RULES.visible, states[id] & SPLAT_RULES.selected);
    this.worker.postMessage({ states });
    this.wanted = true;
  }

  displace(displacement) {
    this.displacement = displacement;
    this.worker.postMessage({ displacement });
    this.wanted = true;
  }

  take({ order, serial }) {
    const gl = this.gl;
    this.sorting = false;
    this.sorted = true;
    this.count = order.length;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    this.leaving = this.leaving.filter(([slot, first]) => {
      if (first <= serial) this.textures.remove(slot);
      return first > serial;
    });
    this.onchange();
  }

  sort({ view, focal, width, height, near }) {
    if (this.sorting || !(this.wanted || this.last.some((value, i) => Math.abs(value - view[i]) > 1e-4))) return;
    this.sorting = true;
    this.wanted = false;
    this.last = view;
    this.worker.postMessage({
      sort: { view, near, slopes: [width / 2 / focal, height / 2 / focal], serial: ++this.serial },
    });
  }

  // shot: {view, focal, near, lowPass, width, height, background}, in pixels of the canvas. Whether what is drawn is in order.
  draw(shot) {
    const gl = this.gl,
      { view, focal, near, lowPass, width, height, background: b } = shot,
      canvas = this.canvas;
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
    }
    this.sort(shot);
    gl.viewport(0, 0, width, height);
    gl.clearColor(b[0] / 255, b[1] / 255, b[2] / 255, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (this.sorted && this.count) {
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      gl.useProgram(this.program);
      gl.bindVertexArray(this.quad);
      this.textures.bind();
      const at = this.places,
        moved = this.displacement;
      ["shapes", "colors", "marks", "states"].forEach((name, unit) => gl.uniform1i(at[name], unit));
      gl.uniformMatrix4fv(at.view, false, view);
      gl.uniform2f(at.focal, focal, focal);
      gl.uniform2f(at.size, width, height);
      gl.uniform1f(at.near, near);
      gl.uniform1f(at.lowPass, lowPass);
      if (moved) gl.uniformMatrix4fv(at.displacement, false, moved.T);
      gl.uniform1i(at.displaced, moved ? moved.object || -1 : 0);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
    }
    this.onframe(shot, this.sorted);
  }

  // The canvas as it is drawn now; WebGL forgets it once the page has shown it.
  copyTo(context, shot) {
    this.draw(shot);
    context.drawImage(this.canvas, 0, 0);
  }
}

// Some browsers say of a program that it is a GPU.
function drawsInSoftware(gl) {
  let name = gl.getParameter(gl.RENDERER);
  if (/^WebKit/.test(name)) {
    const info = gl.getExtension("WEBGL_debug_renderer_info"); // elsewhere asking for it is complained about
    if (info) name = gl.getParameter(info.UNMASKED_RENDERER_WEBGL);
  }
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

// How far splats reach at most, in metres: 3.33 standard deviations.
function radii({ count, covariances: s }) {
  const found = new Float32Array(count);
  for (let i = 0; i < count; i++) found[i] = 3.34 * Math.sqrt(s[6 * i] + s[6 * i + 3] + s[6 * i + 5]);
  return found;
}
