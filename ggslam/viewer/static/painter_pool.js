// SPDX-License-Identifier: Apache-2.0
// Workers that share the painting of a picture: each has a band of its rows.

class PainterPool {
  constructor(workers = Math.max(1, Math.min(8, navigator.hardwareConcurrency || 2))) {
    this.workers = Array.from({ length: workers }, () => {
      const worker = startWorker(
        paintInWorker,
        { TILE, FALL_STEPS, SEEN_RULES },
        BandPainter,
        SplatProjector,
        TilePainter,
        isDisplaced,
        multiply,
        frameOf,
        cameraOf,
        countingSort,
        ellipseEdge,
        SeenShapes,
        octahedralDirections,
        eyeOf,
      );
      worker.onmessage = (event) => this.take(event.data);
      return worker;
    });
    this.shares = this.workers.map((_, i) => (i + 1) / workers); // where bands end
    this.serial = 0;
    this.jobs = new Map();
  }

  tell(name, ...values) {
    for (const worker of this.workers) worker.postMessage({ [name]: values });
  }

  addChunk(chunk, splats) {
    const { count, centers, covariances, alphas, ids, rgb, seen } = splats;
    this.tell("addChunk", chunk, { count, centers, covariances, alphas, ids, rgb, seen, radius: radii(splats) });
  }

  removeChunk(chunk) {
    this.tell("removeChunk", chunk);
  }

  setColors(chunk, rgb) {
    this.tell("setColors", chunk, rgb);
  }

  setMarks(chunk, bytes) {
    this.tell("setMarks", chunk, bytes);
  }

  setStates(states) {
    this.tell("setStates", states);
  }

  displace(displacement) {
    this.tell("displace", displacement);
  }

  // Paints; onstrip({top, bottom, values}) for each part that is ready. The promise is true when all are, false if a
  // later job came before.
  paint(shot, { strips = 1, kind = "colors", onstrip }) {
    for (const job of this.jobs.values()) job.resolve(false);
    this.jobs.clear();
    const least = shot.sharp ? SPLAT_RULES.minTransmittance : SPLAT_RULES.movingMinTransmittance;
    const serial = ++this.serial,
      rows = Math.ceil(shot.height / TILE),
      ends = this.shares.map((share) => Math.round(share * rows));
    const job = { onstrip, left: 0, times: [], drawn: 0 };
    let top = 0;
    ends.forEach((end, i) => {
      const bottom = Math.min(shot.height, end * TILE);
      if (bottom <= top) return;
      job.left++;
      this.workers[i].postMessage({ start: [{ serial, shot, top, bottom, strips, kind, least }] });
      top = bottom;
    });
    job.promise = new Promise((resolve) => {
      job.resolve = resolve;
    });
    this.jobs.set(serial, job);
    return job.promise;
  }

  // Until nothing is being painted.
  async rest() {
    for (const job of this.jobs.values()) await job.promise;
    if (this.jobs.size) await this.rest();
  }

  // Paints in the breaks that others leave, until all of it is done.
  async finish(shot, options) {
    do await this.rest();
    while (!(await this.paint(shot, options)));
  }

  take(strip) {
    const job = this.jobs.get(strip.serial);
    if (!job) return;
    job.onstrip(strip);
    if (!strip.last) return;
    job.times.push([strip.bottom, strip.milliseconds]);
    job.drawn += strip.drawn;
    if (--job.left) return;
    this.jobs.delete(strip.serial);
    this.drawn = job.drawn;
    this.balance(job.times);
    job.resolve(true);
  }

  // Moves the ends of bands so that all workers need the same time.
  balance(times) {
    if (times.length !== this.workers.length || times.length < 2) return;
    times.sort((one, other) => one[0] - other[0]);
    const mean = times.reduce((sum, [, time]) => sum + time, 0) / times.length;
    let before = 0,
      end = 0;
    const wanted = times.map(([, time], i) => {
      const share = this.shares[i] - before;
      before = this.shares[i];
      return share * (1 + (0.4 * (mean - time)) / Math.max(mean, time));
    });
    const sum = wanted.reduce((one, other) => one + other, 0);
    this.shares = wanted.map((share) => (end += share / sum));
    this.shares[this.shares.length - 1] = 1;
  }

  async depth(shot) {
    const depths = new Float32Array(shot.width * shot.height);
    await this.finish(shot, { kind: "depth", onstrip: ({ top, values }) => depths.set(values, top * shot.width) });
    return depths;
  }
}
