// The map of the site: photographs and what they show of the ground, by device, over a picture of the model from above. It
// knows nothing about the server.
//
// Start reading at SiteMap.show. The map is that of aggregator/src/station/site_map.rs.

/* global svg, counted, isAlive, add, dot, row, geodeticOf */
/* exported SiteMap */

/** Width of the drawing, and its smallest and largest height, in its own units. */
const WIDTH = 1000;
const HEIGHTS = [400, 1200];
/** Margin around the photographs, as a share of the longer side. */
const MARGIN = 0.15;
/** The picture from above is taken from so many times its width, so that walls hardly lean. */
const FROM_WIDTHS = 20;
/** Characters of a name that the map shows; the table has all. */
const NAME_MAX = 20;
/** Steps of the cross over the width of the map. */
const CROSS_STEPS = 50;

class SiteMap {
  /** `told` is the element that tells places. */
  constructor(canvas, told) {
    Object.assign(this, { canvas, told, map: null, picture: null, marks: new Map(), cross: null });
    canvas.addEventListener('pointermove', ({ offsetX, offsetY }) => this.map && this.tellAt(this.worldAt(offsetX, offsetY)));
    canvas.addEventListener('keydown', (event) => this.moveCross(event));
  }

  /** Shows a map. `devices` are those of the page. */
  show(map, devices) {
    this.map = map.devices.length ? map : null;
    if (!this.map) return;
    // Footprints of cameras that look ahead reach far beyond the site, and may be cut off.
    const middle = (c, a) => (c[2 + a] + c[4 + a] + c[6 + a] + c[8 + a]) / 4;
    const placesOf = (c) => [c, [0, 1].map((a) => (c[a] + middle(c, a)) / 2)];
    const points = map.devices.flatMap(({ cameras }) => cameras.flatMap(placesOf));
    const range = [0, 1].map((a) => points.reduce(([low, high], p) => [Math.min(low, p[a]), Math.max(high, p[a])], [Infinity, -Infinity]));
    const margin = Math.max(1, MARGIN * Math.max(...range.map(([low, high]) => high - low)));
    this.low = range.map(([low]) => low - margin);
    const span = range.map(([low, high]) => high - low + 2 * margin);
    this.height = Math.min(HEIGHTS[1], Math.max(HEIGHTS[0], (WIDTH * span[1]) / span[0]));
    // The whole site fits, whichever side is longer.
    this.scale = Math.min(WIDTH / span[0], this.height / span[1]);
    this.low = this.low.map((low, a) => low - ([WIDTH, this.height][a] / this.scale - span[a]) / 2);
    this.canvas.setAttribute('viewBox', `0 0 ${WIDTH} ${this.height.toFixed(0)}`);
    this.told.textContent = `${counted(map.devices.length, 'device')} with photographs; footprints on level ground are estimates.`;
    this.draw(devices);
  }

  draw(devices) {
    this.image = svg('image', { width: WIDTH, height: this.height, preserveAspectRatio: 'none' });
    if (this.picture) this.image.setAttribute('href', this.picture);
    const prints = svg('g', {});
    const marks = svg('g', {});
    this.marks.clear();
    for (const { device, color, cameras } of this.map.devices) {
      for (const camera of cameras) {
        const corners = [2, 4, 6, 8].map((k) => this.at(camera.slice(k, k + 2)).join(','));
        prints.append(svg('polygon', { points: corners.join(' '), fill: color, stroke: color, class: 'print' }));
        const [cx, cy] = this.at(camera);
        marks.append(svg('circle', { cx, cy, r: 4, fill: color }));
      }
      marks.append(...this.markOf(device, cameras, color));
    }
    this.canvas.replaceChildren(this.image, prints, marks, ...this.legend());
    this.tick(devices);
  }

  /** The name of a device in the middle of its photographs, with its heartbeat. */
  markOf(device, cameras, color) {
    const middle = [0, 1].map((a) => cameras.reduce((sum, camera) => sum + camera[a] / cameras.length, 0));
    const [cx, cy] = this.at(middle);
    const beat = svg('circle', { cx, cy, r: 14, fill: 'none', stroke: color, 'stroke-width': 4 });
    const heart = svg('circle', { cx, cy, r: 9, fill: color });
    const name = svg('text', { x: Number(cx) + 16, y: Number(cy) + 7 });
    name.textContent = device.length > NAME_MAX ? `${device.slice(0, NAME_MAX - 1)}…` : device;
    this.marks.set(device, { beat, heart });
    return cameras.length ? [beat, heart, name] : [];
  }

  /** The scale bar, and the arrow to the north if the site is georeferenced. */
  legend() {
    const about = WIDTH / this.scale / 4;
    const power = 10 ** Math.floor(Math.log10(about));
    const length = power * [5, 2, 1].find((factor) => factor * power <= about);
    const [x, y] = [20, this.height - 20];
    const scale = svg('path', { d: `M${x} ${y - 8}v8H${x + length * this.scale}v-8`, class: 'ink' });
    const text = svg('text', { x: x + 8, y: y - 12 });
    text.textContent = this.map.geo ? `${length} m` : `${length} units`;
    if (!this.map.geo) return [scale, text];
    const arrow = svg('path', { d: `M${WIDTH - 40} 90v-60m-12 18l12 -18l12 18`, class: 'ink' });
    const north = svg('text', { x: WIDTH - 48, y: 118 });
    north.textContent = 'N';
    return [scale, text, arrow, north];
  }

  /** Shows which devices were heard lately. */
  tick(devices) {
    for (const [name, { beat, heart }] of this.marks) {
      const alive = devices.has(name) && isAlive(devices.get(name));
      beat.setAttribute('class', alive ? 'beat' : '');
      beat.setAttribute('visibility', alive ? 'visible' : 'hidden');
      heart.setAttribute('fill-opacity', alive ? 1 : 0.4);
    }
  }

  /** Puts a picture of the viewer's model under the map. */
  async look(viewer) {
    if (!this.map) return;
    const { scene, walk } = viewer;
    const [east, north, up] = this.map.axes;
    const middle = [WIDTH, this.height].map((side, a) => this.low[a] + side / this.scale / 2);
    const ground = dot(add(scene.origin, walk.center, scene.unit), up);
    const world = add(add(add([0, 0, 0], east, middle[0]), north, middle[1]), up, ground);
    const distance = (FROM_WIDTHS * WIDTH) / this.scale / scene.unit;
    const eye = add(add(world, scene.origin, -1).map((v) => v / scene.unit), up, distance);
    const rotation = [...east, ...north.map((v) => -v), ...up.map((v) => -v)];
    const size_px = [WIDTH, Math.round(this.height)];
    const focal = this.scale * scene.unit * distance;
    const translation = [0, 1, 2].map((k) => -dot(row(rotation, k), eye));
    this.picture = await viewer.picture({ rotation, translation, focal_px: [focal, focal], center_px: size_px.map((v) => v / 2), size_px });
    viewer.changed();
    this.image.setAttribute('href', this.picture);
  }

  /** Where a point of the world is on the drawing. */
  at([x, y]) {
    return [(x - this.low[0]) * this.scale, this.height - (y - this.low[1]) * this.scale].map((v) => v.toFixed(1));
  }

  /** The point of the world at a point of the element, CSS px. */
  worldAt(x, y) {
    const per = WIDTH / this.canvas.clientWidth;
    return [this.low[0] + (x * per) / this.scale, this.low[1] + (this.height - y * per) / this.scale];
  }

  tellAt(at) {
    const { geo, axes } = this.map;
    const unit = geo ? ' m' : '';
    const place = `${at[0].toFixed(1)}${unit} east, ${at[1].toFixed(1)}${unit} north`;
    if (!geo) return (this.told.textContent = `x ${at[0].toFixed(1)}, y ${at[1].toFixed(1)}`);
    const { latitude_deg: lat, longitude_deg: lon } = geodeticOf(add(add([0, 0, 0], axes[0], at[0]), axes[1], at[1]), geo);
    const side = (value, names) => `${Math.abs(value).toFixed(6)}° ${names[value < 0 ? 1 : 0]}`;
    this.told.textContent = `${place}; ${side(lat, 'NS')}, ${side(lon, 'EW')}`;
  }

  /** Moves a cross with the arrow keys, and tells its place. */
  moveCross(event) {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!step || !this.map) return;
    event.preventDefault();
    const sides = [WIDTH, this.height].map((side) => side / this.scale);
    const before = this.cross ?? sides.map((side, a) => this.low[a] + side / 2);
    this.cross = before.map((v, a) => Math.min(this.low[a] + sides[a], Math.max(this.low[a], v + (step[a] * sides[0]) / CROSS_STEPS)));
    const [x, y] = this.at(this.cross);
    this.crossMark?.remove();
    this.crossMark = svg('path', { d: `M${x - 14} ${y}h28M${x} ${y - 14}v28`, class: 'ink' });
    this.canvas.append(this.crossMark);
    this.tellAt(this.cross);
  }
}
