// Colours splats by what the photographs tell of them: on how many photographs each is, and which device's photograph shows
// it finest. Photographs are taken to see through everything. It knows nothing about WebGL and the page.
//
// Start reading at paint. The worker of sort.js counts.

/* exported paint, legendOf, CONFIDENCE, OWNER */

/** The numbers of the layers that are coloured here; those before are drawn from the splats. */
const [CONFIDENCE, OWNER] = [3, 4];
/** Photographs that are looked at; of more, evenly spaced ones. */
const LOOKS_MAX = 128;
/** Fewest photographs of each class of confidence, with its colour: viridis, which is legible to the colour-blind. */
const CLASSES = [[0, [68, 1, 84]], [2, [59, 82, 139]], [4, [33, 145, 140]], [8, [94, 201, 98]], [16, [253, 231, 37]]];
/** The colour of a splat that is on no photograph of a known device. */
const NOBODY_COLOR = [96, 96, 96];
/** Devices that the legend names. */
const NAMES_MAX = 24;

/** The photographs that are looked at, and how many each of them stands for. */
function looksOf({ cameras, of_cameras: all }) {
  const count = Math.min(cameras.length, LOOKS_MAX);
  const looks = Array.from({ length: count }, (_, i) => cameras[Math.floor((i * cameras.length) / count)]);
  return { looks, each: all / count };
}

const classOf = (count) => CLASSES.findLast(([least]) => count >= least);

/** A texel for each splat: red, green, blue. `marks` are those of Sorter.marks. */
function colorsOf(layer, { counts, owners }, each, devices) {
  const texels = new Uint8Array(4 * SPLATS_PER_ROW * Math.max(1, Math.ceil(counts.length / SPLATS_PER_ROW)));
  counts.forEach((count, i) => {
    const owner = devices[owners[i]]?.color ?? NOBODY_COLOR;
    texels.set(layer === OWNER ? owner : classOf(Math.round(count * each))[1], 4 * i);
  });
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
    if (drawing.layer !== layer || drawing.sorter !== sorter) return false;
    texels = colorsOf(layer, marks, each, scene.devices);
  }
  drawing.takePaint(texels);
  return true;
}

/** What the colours of a layer mean: texts with their colours. */
function legendOf(layer, { devices }) {
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
