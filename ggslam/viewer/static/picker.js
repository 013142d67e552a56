// SPDX-License-Identifier: Apache-2.0
// What is drawn at one place of the screen: of which object, which splat, and where its surface is.

// chunks: Map chunk -> {splats, marks}; states: Uint8 [65536]; ray: [x, y] slopes of the pixel; focal in its pixels.
// Gives {id, chunk, row, point, depth}, or null where more than half of the light is the background's.
function pickSplat(chunks, states, displacement, { view, focal, near }, ray) {
  const hits = [];
  for (const [chunk, { splats, marks }] of chunks)
    for (const hit of splatsOnRay(splats, marks, states, displacement, { view, focal, near }, ray)) hits.push({ chunk, ...hit });
  hits.sort((one, other) => one.z - other.z);
  const objects = new Map();
  let light = 1, surface = 0;
  for (const hit of hits) {
    hit.weight = light * hit.alpha; light *= 1 - hit.alpha;
    objects.set(hit.id, (objects.get(hit.id) || 0) + hit.weight);
    if (!surface && light < 0.5) surface = hit.depth;
    if (light < SPLAT_RULES.minTransmittance) break;
  }
  if (!surface) return null;
  const id = [...objects].sort((one, other) => other[1] - one[1])[0][0];
  const best = hits.filter((hit) => hit.id === id && hit.weight).sort((one, other) => other.weight - one.weight)[0];
  return { id, chunk: best.chunk, row: best.row, depth: surface, point: outOfCamera(view, [ray[0] * surface, ray[1] * surface, surface]) };
}

function outOfCamera(v, [x, y, z]) {
  x -= v[12]; y -= v[13]; z -= v[14];
  return [v[0] * x + v[1] * y + v[2] * z, v[4] * x + v[5] * y + v[6] * z, v[8] * x + v[9] * y + v[10] * z];
}

function splatsOnRay({ count, centers, covariances: s, alphas, ids }, marks, states, displacement, { view, focal, near }, [u, w]) {
  const hits = [], moved = displacement && multiply(view, displacement.T), floor = SPLAT_RULES.lowPass / (focal * focal);
  for (let i = 0; i < count; i++) {
    const mark = marks ? marks[i] : 0;
    if (!(states[ids[i]] & SPLAT_RULES.visible) || mark & SPLAT_RULES.gone) continue;
    const v = displacement && isDisplaced(displacement, ids[i], mark) ? moved : view;
    const x = centers[3 * i], y = centers[3 * i + 1], c = centers[3 * i + 2], z = v[2] * x + v[6] * y + v[10] * c + v[14];
    if (z < near) continue;
    const px = (v[0] * x + v[4] * y + v[8] * c + v[12]) / z, py = (v[1] * x + v[5] * y + v[9] * c + v[13]) / z;
    const dx = u - px, dy = w - py, a = 6 * i;
    if (dx * dx + dy * dy > 12 * ((s[a] + s[a + 3] + s[a + 5]) / (z * z) * (1 + px * px + py * py) + floor)) continue;
    const cov = inCamera(v, s, a), xx = cov[0] + px * (px * cov[5] - 2 * cov[2]), yy = cov[3] + py * (py * cov[5] - 2 * cov[4]);
    const xy = cov[1] - px * cov[4] - py * cov[2] + px * py * cov[5], A = xx / (z * z) + floor, B = xy / (z * z), C = yy / (z * z) + floor;
    const alpha = alphas[i] / 255 * Math.exp(-0.5 * (C * dx * dx - 2 * B * dx * dy + A * dy * dy) / (A * C - B * B));
    if (alpha < SPLAT_RULES.minAlpha) continue;
    hits.push({ row: i, id: ids[i], z, alpha: Math.min(alpha, SPLAT_RULES.maxAlpha), depth: depthOnRay(cov, [px * z, py * z, z], [u, w]) });
  }
  return hits;
}

// Covariance (xx xy xz yy yz zz) in the camera's frame.
function inCamera(v, s, a) {
  const S = [[s[a], s[a + 1], s[a + 2]], [s[a + 1], s[a + 3], s[a + 4]], [s[a + 2], s[a + 4], s[a + 5]]];
  const W = [0, 1, 2].map((k) => [v[k], v[k + 4], v[k + 8]]);
  const form = (j, k) => {
    let sum = 0;
    for (let m = 0; m < 3; m++) for (let n = 0; n < 3; n++) sum += W[j][m] * S[m][n] * W[k][n];
    return sum;
  };
  return [form(0, 0), form(0, 1), form(0, 2), form(1, 1), form(1, 2), form(2, 2)];
}

// Depth of the densest point of a Gaussian on a ray: where its surface is, however slanted it is.
function depthOnRay([xx, xy, xz, yy, yz, zz], p, [u, w]) {
  const least = 1e-6 * (xx + yy + zz); xx += least; yy += least; zz += least;
  const A = yy * zz - yz * yz, B = xz * yz - xy * zz, C = xy * yz - xz * yy, D = xx * zz - xz * xz, E = xy * xz - xx * yz, F = xx * yy - xy * xy;
  const d = [A * u + B * w + C, B * u + D * w + E, C * u + E * w + F]; // inverse covariance times the ray, up to a factor
  return Math.max((d[0] * p[0] + d[1] * p[1] + d[2] * p[2]) / (d[0] * u + d[1] * w + d[2]), 0.5 * p[2]);
}
