// SPDX-License-Identifier: Apache-2.0
// What colours the splats have. A part of `Viewer`.

class ViewerColors {
  colorings() {
    const first = this.map.chunks.values().next().value,
      found = ["colour"];
    if (this.scene.objects.length) found.push("objects");
    if (first?.identity) found.push("identity");
    if (this.scene.frames.length) found.push("depth");
    return found;
  }

  color(name, tell = true) {
    this.coloring = this.colorings().includes(name) ? name : "colour";
    const palette = new Map(this.scene.objects.map((o) => [o.id, o.color]));
    for (const [chunk, splats] of this.map.chunks) this.map.setColors(chunk, this.colorsOf(splats, palette));
    if (tell) {
      this.emit("coloring");
      this.remember();
    }
  }

  colorsOf(splats, palette) {
    if (this.coloring === "colour") return null;
    if (this.coloring === "identity") return splats.identity;
    const rgb = new Uint8Array(3 * splats.count);
    if (this.coloring === "objects")
      for (let i = 0; i < splats.count; i++) rgb.set(palette.get(splats.ids[i]) || [110, 110, 110], 3 * i);
    else {
      const T = this.scene.frames[this.frame].T,
        from = [T[3], T[7], T[11]],
        far = new Float32Array(splats.count);
      for (let i = 0; i < splats.count; i++)
        far[i] = Math.hypot(
          splats.centers[3 * i] - from[0],
          splats.centers[3 * i + 1] - from[1],
          splats.centers[3 * i + 2] - from[2],
        );
      const sorted = far.slice().sort(),
        low = sorted[Math.floor(0.02 * far.length)] || 0,
        high = sorted[Math.floor(0.98 * far.length)] || 1;
      for (let i = 0; i < splats.count; i++) {
        const place = clamp((far[i] - low) / Math.max(high - low, 1e-9), 0, 1) * (DEPTH_STOPS.length - 1),
          k = Math.min(Math.floor(place), DEPTH_STOPS.length - 2);
        rgb.set(between(DEPTH_STOPS[k], DEPTH_STOPS[k + 1], place - k), 3 * i);
      }
    }
    return rgb;
  }

  nextColoring() {
    const all = this.colorings();
    this.color(all[(all.indexOf(this.coloring) + 1) % all.length]);
    this.say(`coloured by ${this.coloring}`);
  }
}
