// SPDX-License-Identifier: Apache-2.0
// What the GPU computes: EWA splatting (Zwicker et al. 2001) with the projection of 3D Gaussian splatting (Kerbl et al.
// 2023), and blending of splats that come farthest first.

const SPLAT_VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp usampler2D;
uniform usampler2D shapes, colors, marks; uniform sampler2D states;
uniform mat4 view, displacement; uniform vec2 focal, size; uniform float near, lowPass;
uniform int displaced; // id, or -1: marked
in vec2 corner; in uint which;
out vec2 place; out vec4 color;
vec3 octahedral(vec2 code) {
  code = code / 127.5 - 1.0; float z = 1.0 - abs(code.x) - abs(code.y), under = max(-z, 0.0);
  return normalize(vec3(code - mix(vec2(-under), vec2(under), greaterThanEqual(code, vec2(0))), z));
}
float fall(float cosine, float begin, float over) { // 1 at an angle of begin degrees, 0 over degrees later
  float from = cos(radians(min(180.0, begin))), to = cos(radians(min(180.0, begin + over)));
  return cosine >= from ? 1.0 : clamp((cosine - to) / (from - to), 0.0, 1.0);
}
// As SeenShapes does: the share of its opacity that a splat has, seen from an offset; sigma may get shorter.
float look(uint seen, vec3 eye, float size, inout mat3 sigma) {
  float far = float(seen >> 24), distance = length(eye), cone = float((seen >> 16) & 255u) * 180.0 / 255.0;
  float seenAt = ${SEEN_RULES.nearest} * pow(${SEEN_RULES.step}, far - 1.0);
  float allowed = max(${SEEN_RULES.size}, far > 0.0 ? ${SEEN_RULES.growth.toFixed(3)} * size / seenAt : 0.0);
  float share = clamp(2.0 - size / (distance * allowed), 0.0, 1.0);
  if (share <= 0.0 || far == 0.0) return share;
  vec3 d = octahedral(vec2(seen & 255u, (seen >> 8) & 255u)); float cosine = dot(d, eye) / distance;
  float along = dot(d, sigma * d), beside = sigma[0][0] + sigma[1][1] + sigma[2][2] - along;
  float beginning = cone + ${SEEN_RULES.shortenBeside.toFixed(1)};
  float strength = 1.0 - fall(cosine, beginning, ${SEEN_RULES.shortenOver.toFixed(1)});
  if (along > beside && strength > 0.0) {
    mat3 S = mat3(1) + strength * (sqrt(max(0.0, beside / along)) - 1.0) * outerProduct(d, d);
    sigma = S * sigma * S;
  }
  float begin = max(${SEEN_RULES.fadeFrom.toFixed(1)}, cone + ${SEEN_RULES.fadeBeside.toFixed(1)});
  return share * fall(cosine, begin, ${SEEN_RULES.fadeOver.toFixed(1)});
}
void main() {
  gl_Position = vec4(0, 0, 2, 1);
  ivec2 at = ivec2(int(which) & 1023, int(which) >> 10);
  uvec4 a = texelFetch(shapes, ivec2(3 * at.x, at.y), 0), b = texelFetch(shapes, ivec2(3 * at.x + 1, at.y), 0);
  uvec4 c = texelFetch(shapes, ivec2(3 * at.x + 2, at.y), 0), rgba = texelFetch(colors, at, 0);
  uint mark = texelFetch(marks, at, 0).r;
  vec4 state = texelFetch(states, ivec2(int(a.w) & 255, int(a.w) >> 8), 0);
  if (state.r < 0.5 || (mark & ${SPLAT_RULES.gone}u) != 0u || rgba.a == 0u) return;
  mat4 camera = view;
  bool marked = (mark & ${SPLAT_RULES.marked}u) != 0u;
  if (displaced == int(a.w) && displaced > 0 || displaced == -1 && marked) camera = view * displacement;
  vec3 p = (camera * vec4(uintBitsToFloat(a.xyz), 1)).xyz;
  if (p.z < near) return;
  vec4 s = uintBitsToFloat(b); vec2 t = uintBitsToFloat(c.xy);
  mat3 sigma = mat3(s.x, s.y, s.z, s.y, s.w, t.x, s.z, t.x, t.y);
  float share = 1.0;
  if (c.w != 0u) {
    vec3 eye = -transpose(mat3(camera)) * camera[3].xyz - uintBitsToFloat(a.xyz);
    share = look(c.z, eye, sqrt(s.x + s.w + t.y), sigma);
    if (share <= 0.0) return;
  }
  vec2 limit = ${SPLAT_RULES.slopeMargin} * size / focal, ray = clamp(p.xy / p.z, -limit, limit);
  mat3 J = mat3(focal.x / p.z, 0, 0, 0, focal.y / p.z, 0, -focal.x * ray.x / p.z, -focal.y * ray.y / p.z, 0);
  mat3 T = J * mat3(camera); mat3 cov = T * sigma * transpose(T);
  float xx = cov[0][0] + lowPass, xy = cov[0][1], yy = cov[1][1] + lowPass;
  float middle = 0.5 * (xx + yy), off = length(vec2(0.5 * (xx - yy), xy));
  float large = middle + off, small = max(middle - off, 0.01);
  color = vec4(rgba) / 255.0 * vec4(1, 1, 1, share);
  float reach = sqrt(2.0 * log(max(255.0 * color.a, 1.001)));
  vec2 axis = abs(xy) < 1e-6 ? (xx >= yy ? vec2(1, 0) : vec2(0, 1)) : normalize(vec2(xy, large - xx));
  vec2 sides = reach * corner * min(sqrt(vec2(large, small)), 1024.0);
  vec2 shift = sides.x * axis + sides.y * vec2(axis.y, -axis.x);
  vec2 pixel = focal * p.xy / p.z + shift;
  if (state.g > 0.5 || marked)
    color.rgb = mix(color.rgb, vec3(${SPLAT_RULES.tint}) / 255.0, ${SPLAT_RULES.tintShare});
  place = reach * corner;
  gl_Position = vec4(2.0 * pixel.x / size.x, -2.0 * pixel.y / size.y, 0, 1);
}`;
const SPLAT_FRAGMENT = `#version 300 es
precision highp float; in vec2 place; in vec4 color; out vec4 result;
void main() {
  float alpha = color.a * exp(-0.5 * dot(place, place));
  if (alpha < ${SPLAT_RULES.minAlpha}) discard;
  alpha = min(${SPLAT_RULES.maxAlpha}, alpha);
  result = vec4(color.rgb * alpha, alpha);
}`;

function buildProgram(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, text] of [
    [gl.VERTEX_SHADER, vertex],
    [gl.FRAGMENT_SHADER, fragment],
  ]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  return program;
}
