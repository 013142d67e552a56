// SPDX-License-Identifier: Apache-2.0
// The preview of a move: {T: Float32 [16] column-major, object: id or 0, marks: bool}. Runs in workers, too.

function isDisplaced({ object, marks }, id, mark) {
  return object ? id === object : marks && (mark & SPLAT_RULES.marked) !== 0;
}

// a b of 4 x 4 matrices, column-major.
function multiply(a, b) {
  const found = new Float32Array(16);
  for (let column = 0; column < 4; column++)
    for (let row = 0; row < 4; row++) {
      let sum = 0;
      for (let k = 0; k < 4; k++) sum += a[4 * k + row] * b[4 * column + k];
      found[4 * column + row] = sum;
    }
  return found;
}
