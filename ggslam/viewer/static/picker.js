// SPDX-License-Identifier: Apache-2.0
// What is drawn at one place of the screen: of which object, which splat, and where its surface is.

// chunks: Map chunk -> {splats, marks}; states: Uint8 [65536]; shot: {view, focal, near, width, height, lowPass} in pixels of
// the screen; ray: [x, y] slopes of the pixel.
// Gives {id, chunk, row, point, depth}, or null where more than half of the light is the background's.
function pickSplat(chunks, states, displacement, shot, ray) {
  const hits = [];
  for (const [chunk, { splats, marks }] of chunks)
    for (const hit of splatsOnRay(splats, marks, states, displacement, shot, ray)) hits.push({ chunk, ...hit });
  hits.sort((one, other) => one.z - other.z);
  const objects = new Map();
  let light = 1,
    middle = 0;
  for (const hit of hits) {
    hit.weight = light * hit.alpha;
    light *= 1 - hit.alpha;
    objects.set(hit.id, (objects.get(hit.id) || 0) + hit.weight);
    if (!middle && light < 0.5) middle = hit.z;
    if (light < SPLAT_RULES.minTransmittance) break;
  }
  if (!middle) return null;
  const id = [...objects].sort((one, other) => other[1] - one[1])[0][0];
  const surface = meanDepth(hits.filter((hit) => hit.weight && Math.abs(hit.z - middle) < 0.05 * middle));
  const best = hits.filter((hit) => hit.id === id && hit.weight).sort((one, other) => other.weight - one.weight)[0];
  const point = outOfCamera(shot.view, [ray[0] * surface, ray[1] * surface, surface]);
  return { id, chunk: best.chunk, row: best.row, depth: surface, point };
}

// Maps are trained so that weighted means of depth are those measured; beside an edge only one side counts.
function meanDepth(hits) {
  let sum = 0,
    weights = 0;
  for (const { z, weight } of hits) {
    sum += weight * z;
    weights += weight;
  }
  return sum / weights;
}

function outOfCamera(v, [x, y, z]) {
  x -= v[12];
  y -= v[13];
  z -= v[14];
  return [v[0] * x + v[1] * y + v[2] * z, v[4] * x + v[5] * y + v[6] * z, v[8] * x + v[9] * y + v[10] * z];
}

function splatsOnRay(splats, marks, states, displacement, { view, focal, near, width, height, lowPass }, [u, w]) {
  const { count, centers, alphas, ids, covariances: all } = splats,
    shapes = shapesOf(splats);
  const eyes = [view, displacement && multiply(view, displacement.T)].map((v) => v && eyeOf(v));
  const limitX = (SPLAT_RULES.slopeMargin * width) / focal,
    limitY = (SPLAT_RULES.slopeMargin * height) / focal,
    hits = [];
  const moved = displacement && multiply(view, displacement.T),
    floor = lowPass / (focal * focal);
  for (let i = 0; i < count; i++) {
    const mark = marks ? marks[i] : 0;
    if (!(states[ids[i]] & SPLAT_RULES.visible) || mark & SPLAT_RULES.gone) continue;
    const v = displacement && isDisplaced(displacement, ids[i], mark) ? moved : view;
    const x = centers[3 * i],
      y = centers[3 * i + 1],
      c = centers[3 * i + 2],
      z = v[2] * x + v[6] * y + v[10] * c + v[14];
    if (z < near) continue;
    const px = (v[0] * x + v[4] * y + v[8] * c + v[12]) / z,
      py = (v[1] * x + v[5] * y + v[9] * c + v[13]) / z;
    const dx = u - px,
      dy = w - py,
      a = 6 * i,
      jx = Math.max(-limitX, Math.min(limitX, px)),
      jy = Math.max(-limitY, Math.min(limitY, py));
    if (dx * dx + dy * dy > 12 * (((all[a] + all[a + 3] + all[a + 5]) / (z * z)) * (1 + jx * jx + jy * jy) + floor))
      continue;
    let s = all,
      at = a,
      share = 1;
    if (shapes) {
      const eye = eyes[v === moved ? 1 : 0];
      share = shapes.look(i, eye[0] - x, eye[1] - y, eye[2] - c, Math.sqrt(all[a] + all[a + 3] + all[a + 5]));
      s = shapes.shape;
      at = 0;
    }
    const cov = inCamera(v, s, at),
      xx = cov[0] + jx * (jx * cov[5] - 2 * cov[2]),
      yy = cov[3] + jy * (jy * cov[5] - 2 * cov[4]);
    const xy = cov[1] - jx * cov[4] - jy * cov[2] + jx * jy * cov[5],
      A = xx / (z * z) + floor,
      B = xy / (z * z),
      C = yy / (z * z) + floor;
    const alpha =
      ((share * alphas[i]) / 255) * Math.exp((-0.5 * (C * dx * dx - 2 * B * dx * dy + A * dy * dy)) / (A * C - B * B));
    if (alpha < SPLAT_RULES.minAlpha) continue;
    hits.push({ row: i, id: ids[i], z, alpha: Math.min(alpha, SPLAT_RULES.maxAlpha) });
  }
  return hits;
}

// Made when something is picked first.
function shapesOf(splats) {
  if (splats.seen && !splats.shapes) splats.shapes = new SeenShapes(splats.seen, splats.covariances);
  return splats.shapes || null;
}

// Covariance (xx xy xz yy yz zz) in the camera's frame.
function inCamera(v, s, a) {
  const S = [
    [s[a], s[a + 1], s[a + 2]],
    [s[a + 1], s[a + 3], s[a + 4]],
    [s[a + 2], s[a + 4], s[a + 5]],
  ];
  const W = [0, 1, 2].map((k) => [v[k], v[k + 4], v[k + 8]]);
  const form = (j, k) => {
    let sum = 0;
    for (let m = 0; m < 3; m++) for (let n = 0; n < 3; n++) sum += W[j][m] * S[m][n] * W[k][n];
    return sum;
  };
  return [form(0, 0), form(0, 1), form(0, 2), form(1, 1), form(1, 2), form(2, 2)];
}
