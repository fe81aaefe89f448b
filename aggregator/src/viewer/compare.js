// Shows the revision before beside the one of the page: a slider moves the border between both. It knows nothing about input.
//
// Start reading at Comparison. The revision before N is at before/N/scene.json and before/N/model.spz: newer ones than the page
// shows may have come since.

/* global decodeSpz, Drawing, paint, add, dot */
/* exported Comparison */

class Comparison {
  /** Loads the revision before. Throws an Error with one line of text if there is none. `main` is the page's scene. */
  static async load(section, main) {
    const names = ['scene.json', 'model.spz'].map((name) => `before/${main.revision}/${name}`);
    const [described, file] = await Promise.all(names.map((name) => fetch(name)));
    if (!described.ok || !file.ok) throw new Error('The revision before is not kept, or is too large to show.');
    const model = await decodeSpz(new Uint8Array(await file.arrayBuffer()));
    return new Comparison(section, main, await described.json(), model);
  }

  constructor(section, main, scene, model) {
    [this.main, this.scene] = [main, scene];
    this.canvas = section.querySelector('.before');
    this.slide = section.querySelector('.slide');
    this.drawing = new Drawing(this.canvas, model);
    this.slide.querySelector('input').addEventListener('input', () => this.move());
    this.toggle(true);
  }

  get isShown() {
    return !this.canvas.hidden;
  }

  toggle(isShown) {
    this.canvas.hidden = this.slide.hidden = !isShown;
    this.move();
  }

  /** How far the border is from the left, percent. */
  get border() {
    return Number(this.slide.querySelector('input').value);
  }

  set border(percent) {
    this.slide.querySelector('input').value = percent;
    this.move();
  }

  /** Shows the revision before to the left of the border. */
  move() {
    this.canvas.style.clipPath = `inset(0 ${100 - this.border}% 0 0)`;
  }

  /** Colours the revision before for a layer; see `paint` of marks.js. */
  paint(layer) {
    return paint(this.drawing, this.scene, layer);
  }

  /** The same camera in the frame of the revision before: both frames lie in the world without a turn. */
  cameraOf(camera) {
    const apart = add(this.scene.origin, this.main.origin, -1);
    const turned = [0, 1, 2].map((k) => dot(camera.rotation.slice(3 * k, 3 * k + 3), apart));
    const translation = turned.map((v, k) => (v + this.main.unit * camera.translation[k]) / this.scene.unit);
    return { ...camera, translation };
  }

  /** Draws in the splats' last order, and again once they are sorted. */
  async show(camera, layer) {
    if (!this.isShown) return;
    const its = this.cameraOf(camera);
    this.drawing.draw(its, layer);
    if (await this.drawing.sort(its)) this.drawing.draw(its, layer);
  }
}
