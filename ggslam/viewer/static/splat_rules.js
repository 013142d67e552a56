// SPDX-License-Identifier: Apache-2.0
// The rules of drawing, those of ggslam/rendering/reference.py; workers get a copy. Coordinates: x right, y down, z
// forward. Screens have their principal point in the middle.

const SPLAT_RULES = Object.freeze({
  lowPass: 0.3, // pixels squared, added to both variances of a projected splat, at the size of the training
  largestZoom: 50,
  minAlpha: 1 / 255, // fainter contributions are left out
  maxAlpha: 0.999,
  minTransmittance: 1e-4, // a pixel takes no further splat once its transmittance is below
  movingMinAlpha: 4 / 255,
  movingMinTransmittance: 0.05, // coarser, while the camera moves without a GPU
  slopeMargin: 0.65, // of the screen: slopes beyond are clamped in the Jacobian
  visible: 1,
  selected: 2, // bits of an object's state
  marked: 1,
  gone: 2, // bits of a splat's marks
  tint: [255, 217, 26],
  tintShare: 0.45, // of what is selected
});

// As low_pass_for of ggslam/rendering/types.py: the filter of pictures of a focal length, pixels, of a map that ones of
// others taught (not known: none).
function lowPassFor(focal, trained) {
  let zoom = 0;
  for (const one of trained || []) {
    const next = focal / one;
    const nearer = Math.abs(Math.log(next)) - Math.abs(Math.log(zoom || Infinity));
    if (nearer < 0 || (nearer === 0 && next < zoom)) zoom = next;
  }
  const square = zoom ? Math.min(zoom, SPLAT_RULES.largestZoom) ** 2 : 1;
  return SPLAT_RULES.lowPass * square + (1 - square) / 12;
}

// A worker from functions and classes of this page: `main` runs in it and sees `parts` and constants by their names.
function startWorker(main, constants, ...parts) {
  const text = [
    `"use strict"; const SPLAT_RULES = ${JSON.stringify(SPLAT_RULES)};`,
    ...Object.entries(constants).map(([name, value]) => `const ${name} = ${JSON.stringify(value)};`),
    ...parts.map(String),
    `(${main})();`,
  ];
  const address = URL.createObjectURL(new Blob([text.join("\n")], { type: "text/javascript" }));
  const worker = new Worker(address);
  setTimeout(() => URL.revokeObjectURL(address), 10000); // some browsers have not read it yet
  return worker;
}
