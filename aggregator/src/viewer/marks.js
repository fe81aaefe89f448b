// Colours splats by what is known of them: on how many photographs each is, which device's photograph shows it finest, how old
// that device's model is, and how far the splat is from the true surface. A splat counts as being on a photograph even if
// another one hides it there. It knows nothing about WebGL and the page.
//
// Start reading at paint. The worker of sort.js counts.

/* global SPLATS_PER_ROW */
/* exported paint, legendOf, TOLD, hasLayer, CONFIDENCE */

/** The numbers of the layers that are coloured here; those before are drawn from the splats. */
const [CONFIDENCE, OWNER, AGE, ERROR] = [3, 4, 5, 6];
/** What the viewer says about a layer. */
const TOLD = {
  [CONFIDENCE]: 'On how many photographs each place is; what stands in the way is not considered.',
  [OWNER]: 'The device whose photograph shows each place finest; what stands in the way is not considered.',
  [AGE]: 'How long ago the model arrived of the device whose photograph shows each place finest.',
  [ERROR]: 'How far each splat is from the true surface, along the rays of photographs.',
};
/** Photographs that are looked at; of more, evenly spaced ones. */
const LOOKS_MAX = 128;
/** Fewest photographs of each class of confidence, with its colour: viridis, which is legible to the colour-blind. */
const CLASSES = [[0, [68, 1, 84]], [2, [59, 82, 139]], [4, [33, 145, 140]], [8, [94, 201, 98]], [16, [253, 231, 37]]];
/** The colour of a splat that is on no photograph of a known device. */
const NOBODY_COLOR = [96, 96, 96];
/** Ends of the classes of ages, s, and of all classes with their colours, newest first: viridis. */
const AGES = [
  [600, 'less than 10 minutes', [253, 231, 37]],
  [3600, 'less than an hour', [144, 215, 67]],
  [86400, 'less than a day', [53, 183, 121]],
  [604800, 'less than a week', [33, 145, 140]],
  [2592000, 'less than 30 days', [49, 104, 142]],
  [31536000, 'less than a year', [68, 57, 131]],
  [Infinity, 'older', [68, 1, 84]],
];
/** The colours of the classes of errors, least first. */
const ERROR_COLORS = [[49, 104, 142], [38, 148, 140], [94, 201, 98], [253, 231, 37], [248, 149, 64], [214, 69, 56], [140, 20, 90]];
/** Devices that the legend names. */
const NAMES_MAX = 24;

/** The photographs that are looked at, and how many each of them stands for. */
function looksOf({ cameras, of_cameras: all }) {
  const count = Math.min(cameras.length, LOOKS_MAX);
  const looks = Array.from({ length: count }, (_, i) => cameras[Math.floor((i * cameras.length) / count)]);
  return { looks, each: all / count };
}

const classOf = (count) => CLASSES.findLast(([least]) => count >= least);

/** Whether a scene has what a layer shows. */
function hasLayer(layer, { cameras, devices, errors }) {
  if (layer === CONFIDENCE) return cameras.length > 0;
  if (layer === OWNER) return devices.length > 1;
  if (layer === AGE) return devices.some(({ arrived_s: arrived }) => arrived);
  return layer < CONFIDENCE || Boolean(errors);
}

/** The colour of the age of a device's model. */
function ageColor({ arrived_s: arrived }) {
  const age = Date.now() / 1000 - arrived;
  return arrived ? AGES.find(([most]) => age < most)[2] : NOBODY_COLOR;
}

/** The colour of a splat by its place in the file. `marks` are those of Sorter.marks. */
function colorOf(layer, { counts, owners }, each, { devices, errors }) {
  if (layer === CONFIDENCE) return (i) => classOf(Math.round(counts[i] * each))[1];
  if (layer === ERROR) return (i) => ERROR_COLORS[errors?.classes[i]] ?? NOBODY_COLOR;
  const colors = devices.map(layer === OWNER ? ({ color }) => color : ageColor);
  return (i) => colors[owners[i]] ?? NOBODY_COLOR;
}

/** A texel for each splat: red, green, blue. */
function colorsOf(layer, marks, each, scene) {
  const count = marks.counts.length;
  const texels = new Uint8Array(4 * SPLATS_PER_ROW * Math.max(1, Math.ceil(count / SPLATS_PER_ROW)));
  const of = colorOf(layer, marks, each, scene);
  for (let i = 0; i < count; i++) texels.set(of(i), 4 * i);
  return texels;
}

/**
 * Gives a drawing of a scene's splats the colours of a layer, or their own colours back. Counting may take a second. Resolves to
 * false if the drawing has got another layer or another model meanwhile.
 */
async function paint(drawing, scene, layer) {
  const { sorter } = drawing;
  drawing.layer = layer;
  let texels = null;
  if (layer >= CONFIDENCE) {
    const { looks, each } = looksOf(scene);
    const marks = await sorter.marks(looks);
    if (!marks || drawing.layer !== layer || drawing.sorter !== sorter) return false;
    texels = colorsOf(layer, marks, each, scene);
  }
  drawing.takePaint(texels);
  return true;
}

/** What the colours of a layer mean: texts with their colours. */
function legendOf(layer, { devices, errors }) {
  if (layer === AGE) return [...AGES.map(([, text, color]) => [text, color]), ['not known', NOBODY_COLOR]];
  if (layer === ERROR) {
    const texts = errors.bounds_m.map((bound) => `less than ${Math.round(100 * bound)} cm`);
    return [...texts, 'more'].map((text, i) => [text, ERROR_COLORS[i]]).concat([['not known', NOBODY_COLOR]]);
  }
  if (layer === CONFIDENCE) {
    return CLASSES.map(([least, color], i) => {
      const next = CLASSES[i + 1]?.[0];
      return [next ? `${least} to ${next - 1} photographs` : `${least} or more`, color];
    });
  }
  const named = devices.slice(0, NAMES_MAX).map(({ name, color }) => [name, color]);
  const more = devices.length - named.length;
  return [...named, [more > 0 ? `${more} more devices have colours of their own; grey: no photograph` : 'on no photograph', NOBODY_COLOR]];
}
