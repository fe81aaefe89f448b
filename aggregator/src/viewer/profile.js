// The heights of the surface along a line, and their chart. It knows nothing about input and the page.
//
// Start reading at heightsAlong.

/* global add, dot, cross, heightOf */
/* exported heightsAlong, chartOf */

/** Points of a profile. */
const PROFILE_POINTS = 200;
/** The camera of a profile is so many times the line's length away, so that walls hardly lean; less where the browser does
 * not blend 32 bits, because depths get coarser with the distance. */
const FROM_LENGTHS = { full: 20, half: 3 };
/** Size of the chart, in its own units. */
const CHART = [600, 160];

/** Heights of the surface, in the world, at evenly spaced points of the line between two points, seen from above; null where
 * there is no surface. Also returns the line's length on the map, in the world. */
async function heightsAlong(drawing, walk, scene, [from, to]) {
  const { up } = walk;
  const whole = add(to, from, -1);
  const level = add(whole, up, -dot(whole, up));
  const length = Math.hypot(...level);
  if (!(length > 0)) return { heights: [], length: 0 };
  const along = level.map((v) => v / length);
  const distance = walk.size + length * (drawing.isFull ? FROM_LENGTHS.full : FROM_LENGTHS.half);
  const middle = add(add(from, up, Math.max(0, dot(whole, up))), level, 0.5);
  const eye = add(middle, up, distance);
  const forward = up.map((v) => -v);
  const rotation = [...along, ...cross(forward, along), ...forward];
  const translation = [0, 1, 2].map((k) => -dot(rotation.slice(3 * k, 3 * k + 3), eye));
  const focal = (PROFILE_POINTS * distance) / length;
  const size_px = [PROFILE_POINTS, 3];
  const camera = { rotation, translation, focal_px: [focal, focal], center_px: size_px.map((v) => v / 2), size_px };
  while (!(await drawing.sort(camera)));
  const depths = drawing.depthsFrom(camera, [0.5, 1.5], PROFILE_POINTS);
  const height = (depth) => (depth === null ? null : heightOf(add(eye, up, -depth), up, scene));
  return { heights: depths.map(height), length: length * scene.unit };
}

/** A chart of heights as an SVG element; `text` says the same in words. */
function chartOf(heights, length, text) {
  const make = (name, attributes) => {
    const made = document.createElementNS('http://www.w3.org/2000/svg', name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    return made;
  };
  const known = heights.filter((height) => height !== null);
  const [low, high] = [Math.min(...known), Math.max(...known)];
  const at = (height, i) => {
    const x = (CHART[0] * (i + 0.5)) / heights.length;
    return `${x.toFixed(1)} ${(CHART[1] - 24 - ((CHART[1] - 48) * (height - low)) / Math.max(high - low, 1e-6)).toFixed(1)}`;
  };
  // A gap in the surface is a gap in the line.
  const steps = heights.map((height, i) => (height === null ? '' : `${heights[i - 1] == null ? 'M' : 'L'}${at(height, i)}`));
  const chart = make('svg', { viewBox: `0 0 ${CHART[0]} ${CHART[1]}`, role: 'img', 'aria-label': text });
  chart.append(make('path', { d: steps.join('') || 'M0 0' }));
  for (const [x, y, label] of [[4, 16, high.toFixed(2)], [4, CHART[1] - 6, low.toFixed(2)], [CHART[0] - 70, CHART[1] - 6, length.toFixed(1)]]) {
    const made = make('text', { x, y });
    made.textContent = label;
    chart.append(made);
  }
  return chart;
}
