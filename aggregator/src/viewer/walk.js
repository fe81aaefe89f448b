// The camera that a visitor moves: it orbits a pivot, or walks. It knows nothing about input devices, drawing and the
// page.
//
// Start reading at Walk. Angles are in radians; lengths are in the model's unit (metres if the model is georeferenced).

/* exported Walk, project, unproject */

const PITCH_MAX = 1.55;
/** Vertical field of view, radians: that of a common wide-angle lens. */
const FIELD_OF_VIEW = 0.9;

const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const row = (rotation, k) => rotation.slice(3 * k, 3 * k + 3);
const limit = (value, low, high) => Math.min(high, Math.max(low, value));

/** Where a point is in a camera's picture, `[x px, y px, depth]`. */
function project(camera, point) {
  const at = [0, 1, 2].map((k) => dot(row(camera.rotation, k), point) + camera.translation[k]);
  return [0, 1].map((a) => (camera.focal_px[a] * at[a]) / at[2] + camera.center_px[a]).concat(at[2]);
}

/** The point at a depth behind a point of a camera's picture. */
function unproject(camera, [x, y], depth) {
  const at = [x, y].map((v, a) => ((v - camera.center_px[a]) / camera.focal_px[a]) * depth).concat(depth);
  return [0, 1, 2].reduce((sum, k) => add(sum, row(camera.rotation, k), at[k] - camera.translation[k]), [0, 0, 0]);
}

/** The camera of a visitor. */
class Walk {
  /** `positions` are those of the splats, xyz; `up` is an axis. */
  constructor(positions, up) {
    this.up = up;
    // With z up, "north" is y and "east" is x.
    this.north = Math.abs(up[1]) > 0.5 ? [0, 0, -up[1]] : [0, 1, 0];
    this.east = cross(this.north, up);
    const count = positions.length / 3;
    const step = Math.max(1, Math.floor(count / 10000));
    const sorted = [0, 1, 2].map((k) => {
      const values = [];
      for (let i = 0; i < count; i += step) values.push(positions[3 * i + k]);
      return values.sort((a, b) => a - b);
    });
    const at = (values, share) => values[Math.floor(share * (values.length - 1))] ?? 0;
    this.center = sorted.map((values) => at(values, 0.5));
    this.size = Math.max(1e-3, ...sorted.map((values) => at(values, 0.9) - at(values, 0.1)));
    this.reset();
  }

  /** Looks at the whole model from the south. */
  reset() {
    Object.assign(this, { pivot: this.center, yaw: 0, pitch: -0.7, distance: 1.3 * this.size, isWalking: false });
  }

  forward() {
    const flat = add(add([0, 0, 0], this.east, Math.sin(this.yaw)), this.north, Math.cos(this.yaw));
    return add(add([0, 0, 0], flat, Math.cos(this.pitch)), this.up, Math.sin(this.pitch));
  }

  right() {
    return add(add([0, 0, 0], this.east, Math.cos(this.yaw)), this.north, -Math.sin(this.yaw));
  }

  eye() {
    return add(this.pivot, this.forward(), -this.distance);
  }

  /** The camera for a picture of this size, px. */
  camera(size_px) {
    const [forward, right] = [this.forward(), this.right()];
    const rotation = [...right, ...cross(forward, right), ...forward];
    const eye = this.eye();
    const focal = (0.5 * Math.min(size_px[1], 1.3 * size_px[0])) / Math.tan(FIELD_OF_VIEW / 2);
    const translation = [0, 1, 2].map((k) => -dot(row(rotation, k), eye));
    return { rotation, translation, focal_px: [focal, focal], center_px: size_px.map((v) => v / 2), size_px };
  }

  /** Turns: around the pivot, or on the spot while walking. */
  turn(yaw, pitch) {
    const eye = this.eye();
    this.yaw = (this.yaw + yaw) % (2 * Math.PI);
    this.pitch = limit(this.pitch + pitch, -PITCH_MAX, PITCH_MAX);
    if (this.isWalking) this.pivot = add(eye, this.forward(), this.distance);
  }

  /** Moves along the picture's axes: right, up along the vertical, ahead along the ground. */
  move(right, up, ahead) {
    const flat = add(add([0, 0, 0], this.east, Math.sin(this.yaw)), this.north, Math.cos(this.yaw));
    this.pivot = add(add(add(this.pivot, this.right(), right), this.up, up), flat, ahead);
  }

  /** Moves with the picture, so that a point at the pivot's depth stays below the pointer. Lengths are shares of depth. */
  pan(right, down) {
    const picture = cross(this.forward(), this.right());
    this.pivot = add(add(this.pivot, this.right(), -right * this.distance), picture, -down * this.distance);
  }

  /** Comes nearer to the pivot by a factor; while walking, goes ahead instead. */
  zoom(factor) {
    if (this.isWalking) {
      this.pivot = add(this.pivot, this.forward(), (1 - factor) * 0.1 * this.size);
    } else {
      this.distance = limit(this.distance * factor, 1e-3 * this.size, 20 * this.size);
    }
  }

  /** Takes the place of a photograph's camera, without its roll. The pivot is at the height of the model's middle. */
  takePlace(camera) {
    const [eye, along] = [eyeOf(camera), row(camera.rotation, 2)];
    const above = dot(add(eye, this.center, -1), this.up);
    const distance = above / Math.max(1e-6, -dot(along, this.up));
    this.look(eye, along, distance > 0 && distance < 3 * this.size ? distance : this.distance);
  }

  /** Looks from `eye` along `along`, with the pivot at a distance. */
  look(eye, along, distance) {
    const length = Math.hypot(...along) || 1;
    this.pitch = limit(Math.asin(limit(dot(along, this.up) / length, -1, 1)), -PITCH_MAX, PITCH_MAX);
    // A camera that looks straight down has no direction on the ground; the view then keeps its own.
    const flat = [dot(along, this.east), dot(along, this.north)];
    if (Math.hypot(...flat) > 0.05 * length) this.yaw = Math.atan2(...flat);
    this.distance = distance;
    this.pivot = add(eye, this.forward(), distance);
  }
}
