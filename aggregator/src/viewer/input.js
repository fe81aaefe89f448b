// Turns mouse, touch and keyboard into calls of the viewer. It knows nothing about drawing.
//
// Start reading at listen. `viewer` has `walk`, a Walk; `changed()`, to be called after each change of it; `pick(at)` for a
// click at a point of the canvas, CSS px; and `does(name, value)` for the buttons.

/* exported listen */

/** A pointer that moved less is a click, CSS px. */
const CLICK_PX = 5;
/** Radians that a drag over the height of the canvas turns. */
const TURN = Math.PI;

function listen(canvas, viewer) {
  listenToPointers(canvas, viewer);
  listenToKeys(canvas, viewer);
  canvas.addEventListener('wheel', (event) => {
    event.preventDefault();
    viewer.walk.zoom(Math.exp(Math.max(-0.5, Math.min(0.5, event.deltaY * (event.deltaMode ? 0.05 : 0.0015)))));
    viewer.changed();
  }, { passive: false });
  canvas.addEventListener('contextmenu', (event) => event.preventDefault());
}

function listenToPointers(canvas, viewer) {
  const pointers = new Map();
  let moved = 0;
  const middle = () => [...pointers.values()].reduce((sum, p) => [sum[0] + p[0] / pointers.size, sum[1] + p[1] / pointers.size], [0, 0]);
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return b ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 0;
  };
  canvas.addEventListener('pointerdown', (event) => {
    if (!pointers.size) moved = 0;
    pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    canvas.setPointerCapture(event.pointerId);
    canvas.focus({ preventScroll: true });
  });
  canvas.addEventListener('pointermove', (event) => {
    if (!pointers.has(event.pointerId)) return;
    const before = [middle(), spread()];
    pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    const [dx, dy] = middle().map((v, a) => v - before[0][a]);
    moved += Math.abs(dx) + Math.abs(dy) + Math.abs(spread() - before[1]);
    const pans = pointers.size > 1 || event.shiftKey || (event.buttons & 6) !== 0;
    const height = canvas.clientHeight;
    if (pans) {
      viewer.walk.pan(dx / height, dy / height);
      if (before[1] > 0 && spread() > 0) viewer.walk.zoom(before[1] / spread());
    } else {
      // While orbiting, the model follows the pointer; while walking, the view does.
      const sign = viewer.walk.isWalking ? -1 : 1;
      viewer.walk.turn((sign * dx * TURN) / height, (-sign * dy * TURN) / height);
    }
    viewer.changed();
  });
  const end = (event) => {
    if (!pointers.delete(event.pointerId)) return;
    if (event.type === 'pointerup' && !pointers.size && moved < CLICK_PX) viewer.pick([event.offsetX, event.offsetY]);
  };
  canvas.addEventListener('pointerup', end);
  canvas.addEventListener('pointercancel', end);
}

function listenToKeys(canvas, viewer) {
  const { walk } = viewer;
  const stride = () => 0.04 * (walk.isWalking ? 0.25 * walk.size : walk.distance);
  const keys = {
    ArrowLeft: () => walk.turn(-0.08, 0),
    ArrowRight: () => walk.turn(0.08, 0),
    ArrowUp: () => walk.turn(0, 0.06),
    ArrowDown: () => walk.turn(0, -0.06),
    w: () => walk.move(0, 0, stride()),
    s: () => walk.move(0, 0, -stride()),
    a: () => walk.move(-stride(), 0, 0),
    d: () => walk.move(stride(), 0, 0),
    q: () => walk.move(0, -stride(), 0),
    e: () => walk.move(0, stride(), 0),
    '+': () => walk.zoom(0.9),
    '-': () => walk.zoom(1 / 0.9),
  };
  const buttons = { o: 'walk', m: 'measure', r: 'area', l: 'profile', c: 'compare', n: 'photograph', p: 'before', Home: 'reset', Escape: 'clear', f: 'full', 1: 'layer', 2: 'layer', 3: 'layer', 4: 'layer', 5: 'layer', 6: 'layer', 7: 'layer' };
  canvas.addEventListener('keydown', (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (keys[key]) {
      keys[key]();
      viewer.changed();
    } else if (buttons[key]) {
      viewer.does(buttons[key], Number(key) - 1);
    } else if (key === 'Enter') {
      viewer.pick([canvas.clientWidth / 2, canvas.clientHeight / 2]);
    } else {
      return;
    }
    event.preventDefault();
  });
}
