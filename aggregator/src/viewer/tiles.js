// Shows a large site in detail where the camera is: its tiles near the camera in full, and elsewhere its most important splats,
// the base. Tiles are given up again once the camera is far from them, so the memory is bounded. It knows nothing about
// drawing.
//
// Start reading at Tiles.near. A model is as decode.js describes it.

/* global decodeSpz, GEOMETRY_TEXELS, SPLATS_PER_ROW */
/* exported Tiles */

/** A tile is near if the camera is nearer to it than so many of its widths. A loaded one stays until twice as far. */
const NEAR_WIDTHS = 1;
const KEEP_FACTOR = 2;
/** Largest number of splats in tiles: with the base, less than the million that a common graphics card draws fluently. */
const TILE_SPLATS_MAX = 400000;
/** Tiles that the page asks for at a time. */
const ASKED_MAX = 4;
/** The tile of a splat of the base that lies in none. */
const NO_TILE = 65535;

/** How far a point is from a box. */
function distanceTo({ low, high }, point) {
  return Math.hypot(...[0, 1, 2].map((k) => Math.max(low[k] - point[k], point[k] - high[k], 0)));
}

/** Width of a box: its height does not count, whichever axis is up. */
function widthOf({ low, high }) {
  return [0, 1, 2].map((k) => high[k] - low[k]).sort((a, b) => a - b)[1];
}

/** The tile of each splat of the base. */
function tilesOf({ count, positions }, boxes) {
  const of = new Uint16Array(count).fill(NO_TILE);
  for (let i = 0; i < count; i++) {
    const inside = ({ low, high }) => [0, 1, 2].every((k) => positions[3 * i + k] >= low[k] && positions[3 * i + k] <= high[k]);
    const tile = boxes.findIndex(inside);
    if (tile >= 0) of[i] = tile;
  }
  return of;
}

/** One model of the splats of several. `parts` are models, each with the places of the splats to take; null for all. */
function joined(parts) {
  const { degree } = parts[0][0];
  const count = parts.reduce((sum, [model, places]) => sum + (places ?? model.radii).length, 0);
  const rows = Math.max(1, Math.ceil(count / SPLATS_PER_ROW));
  // Numbers of a splat in each array.
  const sizes = { positions: 3, radii: 1, geometry: 4 * GEOMETRY_TEXELS, harmonics: 4 * Math.ceil((3 * ((degree + 1) ** 2 - 1)) / 16) };
  const whole = { count, degree };
  for (const [name, size] of Object.entries(sizes)) {
    const isTexture = name === 'geometry' || name === 'harmonics';
    whole[name] = new parts[0][0][name].constructor(size * (isTexture ? SPLATS_PER_ROW * rows : count));
    let at = 0;
    for (const [model, places] of parts) {
      const from = model[name];
      if (!places) whole[name].set(from.subarray(0, size * model.count), at);
      else places.forEach((i, k) => whole[name].set(from.subarray(size * i, size * (i + 1)), at + size * k));
      at += size * (places ?? model.radii).length;
    }
  }
  return whole;
}

class Tiles {
  /** `base` is the model of a scene's most important splats. */
  constructor({ revision, boxes }, base) {
    Object.assign(this, { revision, boxes, base, loaded: new Map(), missing: new Set(), shown: base });
    this.of = tilesOf(base, boxes);
  }

  /** The tiles to show in full from a place, nearest first, as long as there is room. */
  wanted(eye) {
    const reach = (tile) => NEAR_WIDTHS * widthOf(this.boxes[tile]) * (this.loaded.has(tile) ? KEEP_FACTOR : 1);
    const all = this.boxes.map((box, tile) => ({ tile, distance: distanceTo(box, eye) }));
    const near = all.filter(({ tile, distance }) => distance <= reach(tile) && !this.missing.has(tile));
    near.sort((a, b) => a.distance - b.distance);
    let room = TILE_SPLATS_MAX;
    const fits = near.findIndex(({ tile }) => (room -= this.boxes[tile].splats) < 0);
    return near.slice(0, fits < 0 ? near.length : fits).map(({ tile }) => tile);
  }

  /** Resolves to the model to show from a place, or to null if it is the one that is shown already. Loads some of the missing
   * tiles, the nearest ones; ask again for the others. */
  async near(eye) {
    const wanted = this.wanted(eye);
    const before = [...this.loaded.keys()].join();
    for (const tile of this.loaded.keys()) if (!wanted.includes(tile)) this.loaded.delete(tile);
    const asked = wanted.filter((tile) => !this.loaded.has(tile)).slice(0, ASKED_MAX);
    await Promise.all(asked.map((tile) => this.load(tile)));
    if ([...this.loaded.keys()].join() === before) return null;
    const shown = [];
    this.of.forEach((tile, i) => this.loaded.has(tile) || shown.push(i));
    this.shown = joined([[this.base, shown], ...[...this.loaded.values()].map((model) => [model, null])]);
    return this.shown;
  }

  /** Loads a tile. One that cannot be loaded, for example of an old revision, is not asked for again. */
  async load(tile) {
    const answer = await fetch(`tiles/${this.revision}/${tile}`).catch(() => null);
    const model = answer?.ok && (await decodeSpz(new Uint8Array(await answer.arrayBuffer())));
    if (model && model.degree === this.base.degree) this.loaded.set(tile, model);
    else this.missing.add(tile);
  }
}
