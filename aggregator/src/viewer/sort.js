// Sorts the splats that a camera may see by depth, in a worker, so that the page stays responsive. It knows nothing about
// drawing.
//
// Start reading at sorter, the code of the worker; Sorter is the page's end of it.

/* exported Sorter */

/**
 * The whole code of the worker. It runs from its own source text, so it may use nothing from outside. Two counting sorts
 * over the lower and upper halves of a depth's bits give the exact order: bits of positive floats sort as the floats do.
 */
function sorter() {
  const BUCKETS = 65536;
  let positions, radii, depths, bits, ids, first, second;

  function load(model) {
    ({ positions, radii } = model);
    const count = radii.length;
    depths = new Float32Array(count);
    bits = new Uint32Array(depths.buffer);
    [ids, first, second] = [new Uint32Array(count), new Uint32Array(count), new Uint32Array(BUCKETS)];
  }

  /** Puts the splats into `ids` that lie in front of the camera and touch its picture, and returns their number. */
  function select({ rotation: r, translation: t, near, slopeMin, slopeMax }) {
    let kept = 0;
    // A sphere is outside of a plane through the camera if its centre is farther than its radius from the plane.
    const slack = [slopeMin[0], slopeMax[0], slopeMin[1], slopeMax[1]].map((slope) => Math.hypot(1, slope));
    for (let i = 0; i < radii.length; i++) {
      const [x, y, z] = [positions[3 * i], positions[3 * i + 1], positions[3 * i + 2]];
      const depth = r[6] * x + r[7] * y + r[8] * z + t[2];
      if (!(depth > near)) continue;
      const right = r[0] * x + r[1] * y + r[2] * z + t[0];
      const down = r[3] * x + r[4] * y + r[5] * z + t[1];
      const radius = radii[i];
      if (slopeMin[0] * depth - right > radius * slack[0] || right - slopeMax[0] * depth > radius * slack[1]) continue;
      if (slopeMin[1] * depth - down > radius * slack[2] || down - slopeMax[1] * depth > radius * slack[3]) continue;
      depths[i] = depth;
      ids[kept++] = i;
    }
    return kept;
  }

  /** Stable counting sort of `from` into `to` by 16 bits of the depths. */
  function pass(from, to, count, shift) {
    second.fill(0);
    for (let i = 0; i < count; i++) second[(bits[from[i]] >>> shift) & 0xffff]++;
    let sum = 0;
    for (let b = 0; b < BUCKETS; b++) [second[b], sum] = [sum, sum + second[b]];
    for (let i = 0; i < count; i++) to[second[(bits[from[i]] >>> shift) & 0xffff]++] = from[i];
  }

  /** For each splat the number of photographs that it is on, and the device of the one that shows it finest, or
   * 65535. */
  function mark(looks) {
    const [counts, owners] = [new Uint8Array(radii.length), new Uint16Array(radii.length).fill(65535)];
    for (let i = 0; i < radii.length; i++) {
      const [x, y, z] = [positions[3 * i], positions[3 * i + 1], positions[3 * i + 2]];
      let finest = Infinity;
      for (const { rotation: r, translation: t, focal_px: f, center_px: c, size_px: size, device } of looks) {
        const depth = r[6] * x + r[7] * y + r[8] * z + t[2];
        if (!(depth > 0)) continue;
        const right = (f[0] * (r[0] * x + r[1] * y + r[2] * z + t[0])) / depth + c[0];
        const down = (f[1] * (r[3] * x + r[4] * y + r[5] * z + t[1])) / depth + c[1];
        if (right < 0 || down < 0 || right > size[0] || down > size[1]) continue;
        counts[i]++;
        if (depth / f[0] < finest && device !== undefined) [finest, owners[i]] = [depth / f[0], device];
      }
    }
    self.postMessage({ counts, owners }, [counts.buffer, owners.buffer]);
  }

  self.onmessage = ({ data }) => {
    if (data.positions) return load(data);
    if (data.looks) return mark(data.looks);
    const count = select(data);
    pass(ids, first, count, 0);
    pass(first, ids, count, 16);
    const depthAt = (share) => (count ? depths[ids[Math.floor(share * (count - 1))]] : 1);
    const range = [depthAt(0.02), depthAt(0.98)];
    const order = ids.slice(0, count).reverse();
    self.postMessage({ id: data.id, order, range }, [order.buffer]);
  };
}

/** Sorts in a worker. Only the newest question waits while one is answered. */
class Sorter {
  constructor(positions, radii) {
    const source = new Blob([`(${sorter})()`], { type: 'text/javascript' });
    const url = URL.createObjectURL(source);
    this.worker = new Worker(url);
    URL.revokeObjectURL(url);
    this.worker.postMessage({ positions, radii });
    this.worker.onmessage = ({ data }) => (data.counts ? this.marking.shift()(data) : this.answer(data));
    [this.asked, this.waiting, this.marking] = [null, null, []];
  }

  /** Ends the worker. All questions that are not answered yet are answered with null. */
  end() {
    this.worker.terminate();
    this.asked?.resolve(null);
    this.waiting?.resolve(null);
    this.marking.forEach((resolve) => resolve(null));
    [this.asked, this.waiting, this.marking] = [null, null, []];
  }

  /** Resolves to `{order, range}`: splats from back to front, and depths that most of them lie between; null if a newer
   * question took the place of this one. */
  sort(camera) {
    this.waiting?.resolve(null);
    return new Promise((resolve) => {
      this.waiting = { camera, resolve };
      this.next();
    });
  }

  /** Resolves to `{counts, owners}` of the splats for these photographs; see `mark`. Null if the worker has ended. */
  marks(looks) {
    return new Promise((resolve) => {
      this.marking.push(resolve);
      this.worker.postMessage({ looks });
    });
  }

  next() {
    if (this.asked || !this.waiting) return;
    [this.asked, this.waiting] = [this.waiting, null];
    this.worker.postMessage(this.asked.camera);
  }

  answer(result) {
    this.asked.resolve(result);
    this.asked = null;
    this.next();
  }
}
