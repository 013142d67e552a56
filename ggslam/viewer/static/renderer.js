// SPDX-License-Identifier: Apache-2.0
// Draws Gaussian splats with WebGL 2, sorted by depth in a worker, after EWA splatting (Zwicker et al. 2001) with the
// projection of 3D Gaussian splatting (Kerbl et al. 2023). Coordinates: x right, y down, z forward.

const LOW_PASS = 0.3; // pixels squared, as ggslam's own renderer and 3DGS add
const VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D;
uniform usampler2D splats; uniform sampler2D states;
uniform mat4 view; uniform vec2 focal, size; uniform float near;
in vec2 corner; in uint which;
out vec2 place; out vec4 color;
uvec4 texel(uint n) { int w = textureSize(splats, 0).x; return texelFetch(splats, ivec2(int(n) % w, int(n) / w), 0); }
void main() {
  gl_Position = vec4(0, 0, 2, 1);
  uvec4 a = texel(which * 3u), b = texel(which * 3u + 1u), c = texel(which * 3u + 2u);
  vec4 state = texelFetch(states, ivec2(int(c.z) & 255, int(c.z) >> 8), 0);
  if (state.r < 0.5) return;
  vec3 p = (view * vec4(uintBitsToFloat(a.xyz), 1)).xyz;
  if (p.z < near) return;
  vec4 s = uintBitsToFloat(b); vec2 t = uintBitsToFloat(c.xy);
  mat3 sigma = mat3(s.x, s.y, s.z, s.y, s.w, t.x, s.z, t.x, t.y);
  vec2 limit = 0.65 * size / focal, ray = clamp(p.xy / p.z, -limit, limit);
  mat3 J = mat3(focal.x / p.z, 0, 0, 0, focal.y / p.z, 0, -focal.x * ray.x / p.z, -focal.y * ray.y / p.z, 0);
  mat3 T = J * mat3(view); mat3 cov = T * sigma * transpose(T);
  float xx = cov[0][0] + ${LOW_PASS}, xy = cov[0][1], yy = cov[1][1] + ${LOW_PASS};
  float middle = 0.5 * (xx + yy), off = length(vec2(0.5 * (xx - yy), xy));
  float large = middle + off, small = max(middle - off, 0.01);
  color = vec4(a.w & 255u, (a.w >> 8) & 255u, (a.w >> 16) & 255u, a.w >> 24) / 255.0;
  float reach = sqrt(2.0 * log(max(255.0 * color.a, 1.001)));
  vec2 axis = abs(xy) < 1e-6 ? (xx >= yy ? vec2(1, 0) : vec2(0, 1)) : normalize(vec2(xy, large - xx));
  vec2 shift = reach * (corner.x * min(sqrt(large), 1024.0) * axis + corner.y * min(sqrt(small), 1024.0) * vec2(axis.y, -axis.x));
  vec2 pixel = focal * p.xy / p.z + shift;
  if (state.g > 0.5) color.rgb = mix(color.rgb, vec3(1, 0.85, 0.1), 0.45);
  place = reach * corner;
  gl_Position = vec4(2.0 * pixel.x / size.x, -2.0 * pixel.y / size.y, 0, 1);
}`;
const FRAGMENT = `#version 300 es
precision highp float; in vec2 place; in vec4 color; out vec4 result;
void main() {
  float alpha = min(0.999, color.a * exp(-0.5 * dot(place, place)));
  if (alpha < 0.0039) discard;
  result = vec4(color.rgb * alpha, alpha);
}`;
const LINE_VERTEX = `#version 300 es
precision highp float; uniform mat4 view; uniform vec2 focal, size; uniform float near; in vec3 point;
void main() {
  vec3 p = (view * vec4(point, 1)).xyz;
  gl_Position = vec4(2.0 * focal * p.xy / size * vec2(1, -1), p.z - 2.0 * near, p.z);
}`;
const LINE_FRAGMENT = `#version 300 es
precision highp float; out vec4 result; void main() { result = vec4(1.0, 0.69, 0.13, 1.0); }`;

// The worker: counting sort by depth along the viewing direction, farthest first.
function sorter() {
  let centers;
  onmessage = (event) => {
    if (event.data.centers) { centers = event.data.centers; return; }
    const [x, y, z] = event.data.forward, count = centers.length / 3, BINS = 65536;
    const depths = new Float32Array(count);
    let low = Infinity, high = -Infinity;
    for (let i = 0; i < count; i++) {
      const depth = x * centers[3 * i] + y * centers[3 * i + 1] + z * centers[3 * i + 2];
      depths[i] = depth;
      if (depth < low) low = depth;
      if (depth > high) high = depth;
    }
    const factor = (BINS - 1) / Math.max(high - low, 1e-9), bins = new Uint16Array(count), starts = new Uint32Array(BINS);
    for (let i = 0; i < count; i++) starts[bins[i] = BINS - 1 - Math.floor((depths[i] - low) * factor)]++;
    for (let bin = 0, sum = 0; bin < BINS; bin++) { const n = starts[bin]; starts[bin] = sum; sum += n; }
    const order = new Uint32Array(count);
    for (let i = 0; i < count; i++) order[starts[bins[i]]++] = i;
    postMessage(order, [order.buffer]);
  };
}

class SplatRenderer {
  // splats: {count, centers Float32 [3n], covariances Float32 [6n] (xx xy xz yy yz zz), alphas Uint8 [n], ids Uint16 [n]}
  constructor(canvas, splats, path, redraw) {
    const gl = this.gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("This browser has no WebGL 2.");
    this.canvas = canvas; this.splats = splats;
    this.program = this.build(VERTEX, FRAGMENT); this.lines = this.build(LINE_VERTEX, LINE_FRAGMENT);
    this.states = new Uint8Array(256 * 256 * 4).fill(0);
    for (let i = 0; i < 65536; i++) this.states[4 * i] = 255;
    const info = gl.getExtension("WEBGL_debug_renderer_info");
    const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
    this.resolution = /swiftshader|llvmpipe|software/i.test(name) ? 0.5 : Math.min(devicePixelRatio, 1.5);
    this.upload();
    this.quad = gl.createVertexArray(); gl.bindVertexArray(this.quad);
    this.attribute(this.program, "corner", new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), 2, 0);
    const which = gl.getAttribLocation(this.program, "which");
    this.order = gl.createBuffer(); gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ARRAY_BUFFER, Uint32Array.from({ length: splats.count }, (_, i) => i), gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(which); gl.vertexAttribIPointer(which, 1, gl.UNSIGNED_INT, 0, 0); gl.vertexAttribDivisor(which, 1);
    this.strip = gl.createVertexArray(); gl.bindVertexArray(this.strip);
    this.attribute(this.lines, "point", new Float32Array(path.flat(2)), 3, 0);
    let first = 0;  // a strip for each camera of each recording
    this.strips = path.map((walk) => { const strip = [first, walk.length]; first += walk.length; return strip; });
    this.worker = new Worker(URL.createObjectURL(new Blob([`(${sorter})()`], { type: "text/javascript" })));
    this.worker.onmessage = (event) => {
      this.sorting = false; this.sorted = true;
      gl.bindBuffer(gl.ARRAY_BUFFER, this.order); gl.bufferSubData(gl.ARRAY_BUFFER, 0, event.data); redraw();
    };
    this.worker.postMessage({ centers: splats.centers });
  }

  build(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind); gl.shaderSource(shader, text); gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }

  attribute(program, name, values, width, divisor) {
    const gl = this.gl, place = gl.getAttribLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer()); gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(place); gl.vertexAttribPointer(place, width, gl.FLOAT, false, 0, 0);
    gl.vertexAttribDivisor(place, divisor);
  }

  texture() {
    const gl = this.gl, texture = gl.createTexture(); gl.bindTexture(gl.TEXTURE_2D, texture);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    return texture;
  }

  upload() {
    const { count, centers, covariances: s, ids } = this.splats, gl = this.gl;
    this.width = Math.min(3072, gl.getParameter(gl.MAX_TEXTURE_SIZE)); this.height = Math.ceil(3 * count / this.width);
    this.words = new Uint32Array(this.width * this.height * 4);
    const numbers = new Float32Array(this.words.buffer);
    for (let i = 0; i < count; i++) {
      numbers.set(centers.subarray(3 * i, 3 * i + 3), 12 * i);
      numbers.set(s.subarray(6 * i, 6 * i + 6), 12 * i + 4);
      this.words[12 * i + 10] = ids[i];
    }
    this.splatTexture = this.texture(); this.stateTexture = this.texture();
  }

  // rgb: Uint8Array [3n]
  recolor(rgb) {
    const { count, alphas } = this.splats, gl = this.gl;
    for (let i = 0; i < count; i++)
      this.words[12 * i + 3] = (rgb[3 * i] | rgb[3 * i + 1] << 8 | rgb[3 * i + 2] << 16 | alphas[i] << 24) >>> 0;
    gl.bindTexture(gl.TEXTURE_2D, this.splatTexture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, this.width, this.height, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, this.words);
  }

  setState(id, visible, selected) { this.states[4 * id] = visible ? 255 : 0; this.states[4 * id + 1] = selected ? 255 : 0; }

  draw(camera) {
    const gl = this.gl, canvas = this.canvas, view = camera.view();
    const width = Math.max(1, Math.round(canvas.clientWidth * this.resolution)), height = Math.max(1, Math.round(canvas.clientHeight * this.resolution));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    this.focal = camera.focal(width, height);
    if (!this.sorting) {
      const forward = [view[2], view[6], view[10]];
      if (!this.last || forward.some((value, i) => Math.abs(value - this.last[i]) > 1e-3)) {
        this.sorting = true; this.last = forward; this.worker.postMessage({ forward });
      }
    }
    gl.viewport(0, 0, width, height); gl.clearColor(0.06, 0.065, 0.075, 1); gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND); gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA); gl.disable(gl.DEPTH_TEST);
    gl.activeTexture(gl.TEXTURE1); gl.bindTexture(gl.TEXTURE_2D, this.stateTexture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 256, 256, 0, gl.RGBA, gl.UNSIGNED_BYTE, this.states);
    gl.activeTexture(gl.TEXTURE0); gl.bindTexture(gl.TEXTURE_2D, this.splatTexture);
    for (const [program, array, draw] of [
      [this.program, this.quad, () => gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.splats.count)],
      [this.lines, this.strip, () => { for (const [from, n] of this.strips) gl.drawArrays(gl.LINE_STRIP, from, n); }]]) {
      const place = (name) => gl.getUniformLocation(program, name);
      gl.useProgram(program); gl.bindVertexArray(array);
      gl.uniformMatrix4fv(place("view"), false, view); gl.uniform2f(place("focal"), this.focal, this.focal);
      gl.uniform2f(place("size"), width, height); gl.uniform1f(place("near"), camera.near);
      gl.uniform1i(place("splats"), 0); gl.uniform1i(place("states"), 1);
      draw();
    }
  }

  // The id whose splats weigh most at a place of the canvas (CSS pixels); 0: none.
  pick(camera, left, top) {
    const { count, centers, covariances: s, alphas, ids } = this.splats, v = camera.view(), f = this.focal / this.resolution;
    const u = (left - this.canvas.clientWidth / 2) / f, w = (top - this.canvas.clientHeight / 2) / f, hits = [];
    for (let i = 0; i < count; i++) {
      if (!this.states[4 * ids[i]]) continue;
      const x = centers[3 * i], y = centers[3 * i + 1], z = centers[3 * i + 2], depth = v[2] * x + v[6] * y + v[10] * z + v[14];
      if (depth < camera.near) continue;
      const px = (v[0] * x + v[4] * y + v[8] * z + v[12]) / depth, py = (v[1] * x + v[5] * y + v[9] * z + v[13]) / depth;
      const dx = u - px, dy = w - py, a = 6 * i, spread = 16 * (s[a] + s[a + 3] + s[a + 5]) / (depth * depth) * (1 + px * px + py * py) + 16 * LOW_PASS / (f * f);
      if (dx * dx + dy * dy > spread) continue;
      const r = [0, 4, 8].map((k) => [(v[k] - px * v[k + 2]) / depth, (v[k + 1] - py * v[k + 2]) / depth]);
      const form = (j, k) => r[0][j] * (s[a] * r[0][k] + s[a + 1] * r[1][k] + s[a + 2] * r[2][k])
        + r[1][j] * (s[a + 1] * r[0][k] + s[a + 3] * r[1][k] + s[a + 4] * r[2][k])
        + r[2][j] * (s[a + 2] * r[0][k] + s[a + 4] * r[1][k] + s[a + 5] * r[2][k]);
      const floor = LOW_PASS / (f * f), xx = form(0, 0) + floor, xy = form(0, 1), yy = form(1, 1) + floor;
      const distance = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy);
      const alpha = Math.min(0.999, alphas[i] / 255 * Math.exp(-0.5 * distance));
      if (alpha > 0.0039) hits.push([depth, alpha, ids[i]]);
    }
    hits.sort((one, other) => one[0] - other[0]);
    const weights = new Map(); let light = 1;
    for (const [, alpha, id] of hits) { weights.set(id, (weights.get(id) || 0) + light * alpha); light *= 1 - alpha; }
    if (light > 0.5) return 0;
    return [...weights].sort((one, other) => other[1] - one[1])[0][0];
  }
}
