// The viewer of a page: loads the model, and connects drawing, camera, input and buttons.
//
// Start reading at startViewer, which the page calls at its end. A page has one section of viewer.html. The model and its
// scene are either elements of the page (a report, which is one file) or fetched from beside the page. The scene is
// `Scene` of aggregator/src/viewer/model.rs.

/* global decodeSpz, bytesOfBase64, Drawing, Walk, Comparison, listen, project, unproject, heightsAlong, chartOf */
/* global Tiles, eyeOf */
/* global describePoint, describeLine, describeArea, describeProfile */
/* global paint, legendOf, TOLD, hasLayer, CONFIDENCE */

/** A frame that takes longer, ms, makes the picture of a moving camera coarser. */
const SLOW_MS = 60;
/** The picture becomes fine again after the camera has rested for this long, ms. */
const REST_MS = 200;

/** Tiles are loaded once the camera has rested for this long, ms. */
const SETTLE_MS = 150;

/** What taps measure, with what the viewer says at first. */
const MEASURES = {
  measure: 'Tap points to measure the distance along them.',
  area: 'Tap the corners of an area.',
  profile: 'Tap two points to see the heights between them.',
};

/** A part of the page, or a file beside it. */
async function fetched(name) {
  const answer = await fetch(name);
  if (!answer.ok) throw new Error('The model could not be loaded; reload the page.');
  return answer;
}

/** The scene, and the files of the model: what to show until there is more, and the whole. */
async function loadScene() {
  const scene = document.getElementById('viewer-scene');
  const model = document.getElementById('viewer-model');
  if (scene && model) return [JSON.parse(scene.textContent), [async () => bytesOfBase64(model.textContent)]];
  const described = await (await fetched('scene.json')).json();
  const file = (name) => async () => new Uint8Array(await (await fetched(name)).arrayBuffer());
  return [described, (described.first_splats ? ['first.spz', 'model.spz'] : ['model.spz']).map(file)];
}

class Viewer {
  constructor(section, scene, model) {
    [this.section, this.scene] = [section, scene];
    this.canvas = section.querySelector('canvas');
    this.told = section.querySelector('.told');
    this.marks = section.querySelector('.marks');
    this.chart = section.querySelector('.chart');
    this.drawing = new Drawing(this.canvas, model);
    this.walk = new Walk(model.positions, scene.up);
    Object.assign(this, { layer: 0, points: [], measuring: null, photograph: -1, coarseness: 1, lastFrame: 0, isAsked: false });
    this.comparison = null;
    listen(this.canvas, this);
    section.querySelector('.bar').addEventListener('click', ({ target }) => {
      if (target.dataset.does) this.does(target.dataset.does, Number(target.dataset.value));
    });
    section.querySelector('[data-does="photograph"]').hidden = !scene.cameras.length;
    for (const button of section.querySelectorAll('[data-value]')) button.hidden = !hasLayer(Number(button.dataset.value), scene);
    // Only the page of a running site has revisions.
    section.querySelector('[data-does="compare"]').hidden = !(Number(document.body.dataset.revision) > 1);
    new ResizeObserver(() => this.changed()).observe(this.canvas);
  }

  /** Shows another model in place of the one before, with the same camera. */
  takeModel(model) {
    this.drawing.takeModel(model);
    this.takeLayer(this.layer);
  }

  /** From now on shows the tiles near the camera in full. `base` is the model that is shown. */
  takeTiles(base) {
    this.tiles = new Tiles(this.scene.tiles, base);
    this.settle();
  }

  /** Once the camera rests, loads the tiles near it, and goes on until there is nothing to load. */
  settle() {
    clearTimeout(this.settling);
    if (!this.tiles || this.isLoading) return;
    this.settling = setTimeout(async () => {
      this.isLoading = true;
      const model = await this.tiles.near(eyeOf(this.camera())).catch(() => null);
      if (model) {
        await this.drawing.replaceModel(model, this.camera());
        await this.takeLayer(this.layer);
      }
      this.isLoading = false;
      // The camera may have moved, and there may be more to load.
      if (model) this.changed();
    }, SETTLE_MS);
  }

  /** Shows a layer. Those of the photographs are coloured first, which may take a second. */
  async takeLayer(layer) {
    if (this.section.querySelector(`[data-value="${layer}"]`).hidden) return;
    this.layer = layer;
    const painted = await Promise.all([paint(this.drawing, this.scene, layer), this.comparison?.paint(layer) ?? true]);
    if (painted.includes(false)) return;
    this.explain();
    const isOfLayer = Object.values(TOLD).includes(this.told.textContent);
    if (TOLD[layer] || isOfLayer) this.tell(TOLD[layer] ?? '');
    this.press();
    this.changed();
  }

  /** Tells what the colours of the layer mean, in the page's model and in the revision before if it is shown. */
  explain() {
    const { layer } = this;
    const entry = ([text, color]) => {
      const [item, swatch] = ['li', 'span'].map((name) => document.createElement(name));
      swatch.style.background = `rgb(${color})`;
      item.append(swatch, text);
      return item;
    };
    const legend = this.section.querySelector('.legend');
    const before = this.comparison?.isShown ? this.comparison.scene.devices : [];
    const gone = before.filter(({ name }) => !this.scene.devices.some((device) => device.name === name));
    const scene = { ...this.scene, devices: [...this.scene.devices, ...gone] };
    legend.replaceChildren(...(layer < CONFIDENCE ? [] : legendOf(layer, scene).map(entry)));
    legend.hidden = layer < CONFIDENCE;
  }

  /** The camera of the page, for a canvas of its size. */
  camera() {
    const density = Math.min(devicePixelRatio || 1, 2) / this.coarseness;
    const side = (css) => Math.max(1, Math.round(css * density));
    return this.walk.camera([side(this.canvas.clientWidth), side(this.canvas.clientHeight)]);
  }

  /** Draws in the next frame, and again as soon as the splats are sorted. */
  changed() {
    this.settle();
    if (this.isAsked) return;
    this.isAsked = true;
    requestAnimationFrame((now) => {
      this.isAsked = false;
      this.adapt(now);
      const camera = this.camera();
      this.show(camera);
      this.drawing.sort(camera).then((isNewest) => isNewest && this.show(this.camera()));
    });
  }

  /** Makes the picture coarser while frames are slow, and fine once the camera rests. */
  adapt(now) {
    const took = now - this.lastFrame;
    this.lastFrame = now;
    if (took < REST_MS && took > SLOW_MS) this.coarseness = Math.min(4, this.coarseness * 2);
    clearTimeout(this.rest);
    if (this.coarseness > 1) {
      this.rest = setTimeout(() => {
        this.coarseness = 1;
        this.lastFrame = 0;
        this.changed();
      }, REST_MS);
    }
  }

  show(camera) {
    const drawn = this.layer < CONFIDENCE ? this.layer : 0;
    this.drawing.draw(camera, drawn);
    this.comparison?.show(camera, drawn);
    const scale = this.canvas.clientWidth / camera.size_px[0];
    const places = this.points.map((point) => project(camera, point)).filter(([, , depth]) => depth > 0);
    const line = places.map(([x, y]) => `${(x * scale).toFixed(1)},${(y * scale).toFixed(1)}`);
    const isClosed = this.measuring === 'area' && line.length > 2;
    this.marks.querySelector('polyline').setAttribute('points', (isClosed ? [...line, line[0]] : line).join(' '));
    this.marks.querySelectorAll('circle').forEach((mark) => mark.remove());
    for (const at of line) {
      const mark = document.createElementNS('http://www.w3.org/2000/svg', 'circle');
      for (const [name, value] of Object.entries({ cx: at.split(',')[0], cy: at.split(',')[1], r: 5 })) mark.setAttribute(name, value);
      this.marks.append(mark);
    }
  }

  /** Tells where the surface is at a point of the canvas, CSS px, and adds it to a measurement. */
  async pick(at) {
    const camera = this.camera();
    await this.drawing.sort(camera);
    const scale = camera.size_px[0] / this.canvas.clientWidth;
    const place = at.map((v) => v * scale);
    const depth = this.drawing.depthAt(camera, place);
    if (depth === null) return this.tell('There is no surface at this point.');
    const point = unproject(camera, place, depth);
    const isFull = this.measuring === 'profile' && this.points.length > 1;
    this.points = this.measuring && !isFull ? [...this.points, point] : [point];
    await this.describe();
    this.changed();
    return point;
  }

  /** Tells what the picked points measure. */
  async describe() {
    const { points, measuring, walk, scene } = this;
    this.chart.replaceChildren();
    if (points.length < 2) return this.tell(describePoint(points[0], scene));
    if (measuring === 'area') return this.tell(describeArea(points, walk, scene));
    if (measuring !== 'profile') return this.tell(describeLine(points, walk.up, scene));
    const { heights, length } = await heightsAlong(this.drawing, walk, scene, points);
    const text = describeProfile(heights, length, scene);
    this.tell(text);
    if (heights.some((height) => height !== null)) this.chart.replaceChildren(chartOf(heights, length, text));
  }

  /** Shows the revision before beside this one, or no longer. */
  async compare() {
    try {
      if (this.comparison) return this.comparison.toggle(!this.comparison.isShown);
      this.tell('The revision before is loading …');
      this.comparison = await Comparison.load(this.section, this.scene);
      await this.comparison.paint(this.layer);
      this.tell(`Left of the border is ${this.comparison.scene.name}, right of it revision ${this.scene.revision}.`);
    } catch (error) {
      this.tell(error.message);
    } finally {
      this.explain();
      this.press();
      this.changed();
    }
  }

  /** What a visitor has set, for another revision of the same site. */
  settings() {
    const { scene, walk, layer, comparison } = this;
    const { yaw, pitch, isWalking } = walk;
    const pivot = add(scene.origin, walk.pivot, scene.unit);
    const place = { pivot, distance: scene.unit * walk.distance, yaw, pitch, isWalking };
    return { layer, place, isCompared: Boolean(comparison?.isShown), border: comparison?.border };
  }

  /** Takes what a visitor has set in another revision, as far as this one has it. */
  async takeSettings({ layer, place, isCompared, border }) {
    const { scene, walk } = this;
    const pivot = add([0, 0, 0], add(place.pivot, scene.origin, -1), 1 / scene.unit);
    Object.assign(walk, place, { pivot, distance: place.distance / scene.unit });
    await this.takeLayer(layer);
    if (isCompared) await this.compare();
    if (this.comparison) this.comparison.border = border;
    this.changed();
  }

  toldOfPhotograph() {
    return `The view of photograph ${this.photograph + 1} of ${this.scene.cameras.length}.`;
  }

  /** Does what a button or key asks for. */
  does(name, value) {
    const { walk, scene } = this;
    if (name === 'layer') this.takeLayer(value);
    if (name === 'walk') walk.isWalking = !walk.isWalking;
    if (name === 'reset') {
      walk.reset();
      if (this.told.textContent === this.toldOfPhotograph()) this.tell('');
    }
    if (name in MEASURES || name === 'clear') {
      [this.measuring, this.points] = [name === 'clear' || this.measuring === name ? null : name, []];
      this.chart.replaceChildren();
      this.tell(MEASURES[this.measuring] ?? 'The measurement has ended.');
    }
    if (name === 'compare' && !this.section.querySelector('[data-does="compare"]').hidden) this.compare();
    if (name === 'full') document.fullscreenElement ? document.exitFullscreen() : this.section.requestFullscreen?.();
    if ((name === 'photograph' || name === 'before') && scene.cameras.length) {
      const count = scene.cameras.length;
      this.photograph = (this.photograph + (name === 'before' ? count - 1 : 1) + (this.photograph < 0 && name === 'before')) % count;
      walk.takePlace(scene.cameras[this.photograph]);
      this.tell(this.toldOfPhotograph());
    }
    if (name === 'save') this.save();
    this.press();
    this.changed();
  }

  /** Shows which buttons are pressed. */
  press() {
    const pressed = { walk: this.walk.isWalking, compare: Boolean(this.comparison?.isShown) };
    for (const button of this.section.querySelectorAll('[aria-pressed]')) {
      const { does, value } = button.dataset;
      button.setAttribute('aria-pressed', does === 'layer' ? Number(value) === this.layer : pressed[does] ?? does === this.measuring);
    }
  }

  tell(text) {
    this.told.textContent = text;
  }

  /** The picture from any camera as a PNG in a `data:` URL, in the camera's size. */
  async picture(camera, layer = 0) {
    while (!(await this.drawing.sort(camera)));
    const { paint } = this.drawing;
    if (layer < CONFIDENCE) this.drawing.paint = null;
    this.drawing.draw(camera, layer < CONFIDENCE ? layer : 0);
    this.drawing.paint = paint;
    return this.canvas.toDataURL('image/png');
  }

  async save() {
    const link = document.createElement('a');
    [link.href, link.download] = [await this.picture(this.camera(), this.layer), 'model.png'];
    link.click();
  }
}

/** What the viewer tells of a loaded model: how many splats it shows, and why not all. Nothing if a small model is shown whole. */
function partsOf({ splats, of_splats: all, broken_splats: broken, tiles }, isLarge) {
  const parts = [];
  if (tiles) parts.push(`${splats} of ${all} splats, the most important ones; near the camera all of them are loaded.`);
  else if (splats < all) parts.push(`To keep this page small, it shows ${splats} of ${all} splats, the most important ones.`);
  else if (isLarge) parts.push(`${splats} splats.`);
  if (broken) parts.push(`${broken === 1 ? '1 splat' : `${broken} splats`} of the file cannot be shown: infinite or not a number.`);
  return parts;
}

/** Starts the viewer of the page. Resolves to the Viewer, or to undefined if it cannot run; the page then tells why. */
async function startViewer() {
  const section = document.querySelector('.viewer');
  const wait = section.querySelector('.wait');
  try {
    const [scene, [first, ...rest]] = await loadScene();
    const viewer = new Viewer(section, scene, await decodeSpz(await first()));
    viewer.changed();
    wait.remove();
    if (rest.length) viewer.tell(`The ${scene.first_splats} most important splats; the rest is loading …`);
    for (const file of rest) {
      const model = await decodeSpz(await file());
      viewer.takeModel(model);
      if (scene.tiles) viewer.takeTiles(model);
    }
    const parts = partsOf(scene, rest.length > 0);
    if (parts.length) viewer.tell(parts.join(' '));
    return viewer;
  } catch (error) {
    // The first part is shown already if only the rest could not be loaded.
    (wait.isConnected ? wait : section.querySelector('.told')).textContent = error.message;
    return undefined;
  }
}

globalThis.cosurf = startViewer();
