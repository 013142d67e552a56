// SPDX-License-Identifier: Apache-2.0
// Splats from the bytes that ggslam/viewer/packed_splats.py packs.

// buffer: ArrayBuffer, deflated; header: {count, low, high, scales, identity, seen}. Gives {count, centers Float32
// [3n], covariances Float32 [6n] (xx xy xz yy yz zz), alphas Uint8 [n], ids Uint16 [n], rgb Uint8 [3n], identity Uint8 [3n]
// or null, seen Uint8 [4n] or null (see `SeenShapes`)}.
async function unpackSplats(buffer, header) {
  const stream = new Blob([buffer]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer()),
    n = header.count;
  let place = 0;
  const column = (width) => {
    if (place + n * width > bytes.length) throw new Error("the splats of this page are cut off");
    return bytes.subarray(place, (place += n * width));
  };
  const steps = [column(2), column(2), column(2)],
    scales = column(3),
    turns = column(4),
    colors = column(3);
  const alphas = column(1).slice(),
    owners = column(2),
    identity = header.identity ? column(3) : null;
  const seen = header.seen ? column(4) : null;
  const ids = new Uint16Array(n);
  for (let i = 0; i < n; i++) ids[i] = owners[i] | (owners[n + i] << 8); // low bytes, then high bytes
  return {
    count: n,
    centers: unpackCenters(n, steps, header),
    covariances: unpackCovariances(n, scales, turns, header.scales),
    alphas,
    ids,
    rgb: interleaved(n, colors),
    identity: identity && interleaved(n, identity),
    seen: seen && interleaved(n, seen, 4),
  };
}

function unpackCenters(n, steps, { low, high }) {
  const centers = new Float32Array(3 * n);
  for (let k = 0; k < 3; k++) {
    const step = (high[k] - low[k]) / 65535,
      part = steps[k];
    for (let i = 0; i < n; i++) centers[3 * i + k] = low[k] + step * (part[i] | (part[n + i] << 8));
  }
  return centers;
}

function unpackCovariances(n, scales, turns, [least, greatest]) {
  const variances = Float64Array.from({ length: 256 }, (_, k) =>
    Math.exp(2 * (least + ((greatest - least) * k) / 255)),
  );
  const found = new Float32Array(6 * n);
  for (let i = 0; i < n; i++) {
    let w = turns[i] - 128,
      x = turns[n + i] - 128,
      y = turns[2 * n + i] - 128,
      z = turns[3 * n + i] - 128;
    const length = Math.sqrt(w * w + x * x + y * y + z * z) || 1;
    w /= length;
    x /= length;
    y /= length;
    z /= length;
    const a = variances[scales[i]],
      b = variances[scales[n + i]],
      c = variances[scales[2 * n + i]];
    const r00 = 1 - 2 * (y * y + z * z),
      r01 = 2 * (x * y - w * z),
      r02 = 2 * (x * z + w * y);
    const r10 = 2 * (x * y + w * z),
      r11 = 1 - 2 * (x * x + z * z),
      r12 = 2 * (y * z - w * x);
    const r20 = 2 * (x * z - w * y),
      r21 = 2 * (y * z + w * x),
      r22 = 1 - 2 * (x * x + y * y),
      k = 6 * i;
    found[k] = r00 * r00 * a + r01 * r01 * b + r02 * r02 * c;
    found[k + 1] = r00 * r10 * a + r01 * r11 * b + r02 * r12 * c;
    found[k + 2] = r00 * r20 * a + r01 * r21 * b + r02 * r22 * c;
    found[k + 3] = r10 * r10 * a + r11 * r11 * b + r12 * r12 * c;
    found[k + 4] = r10 * r20 * a + r11 * r21 * b + r12 * r22 * c;
    found[k + 5] = r20 * r20 * a + r21 * r21 * b + r22 * r22 * c;
  }
  return found;
}

function interleaved(n, column, width = 3) {
  const found = new Uint8Array(width * n);
  for (let i = 0; i < n; i++) for (let k = 0; k < width; k++) found[width * i + k] = column[k * n + i];
  return found;
}
