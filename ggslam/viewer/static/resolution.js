// SPDX-License-Identifier: Apache-2.0
// How many pixels a picture has while the camera moves: as many as can be drawn in time.

class Resolution {
  // least, most: pixels of the picture per CSS pixel; wanted: milliseconds a picture.
  constructor(least, most, wanted) {
    Object.assign(this, { least, most, wanted, scale: most, frameMs: 0 });
  }

  // A picture took so many milliseconds. The share of the work that pixels make is not known, so steps are small.
  took(milliseconds) {
    this.frameMs = this.frameMs ? 0.7 * this.frameMs + 0.3 * milliseconds : milliseconds;
    const factor = Math.sqrt(this.wanted / Math.max(milliseconds, 1));
    if (factor < 0.9 || factor > 1.2) this.scale *= Math.max(0.5, Math.min(1.15, factor));
    this.scale = Math.max(this.least, Math.min(this.most, this.scale));
  }
}
