// Decodes a model in SPZ (github.com/nianticlabs/spz, versions 2 and 3) into the arrays that the viewer draws. It is the
// twin of shared/scene/src/spz.rs. It knows nothing about WebGL and the page.
//
// Start reading at decodeSpz.

/* exported decodeSpz, bytesOfBase64, SPLATS_PER_ROW, GEOMETRY_TEXELS */

/** Splats in a row of the textures. With three texels for each, a row is 3,072 texels wide. */
const SPLATS_PER_ROW = 1024;
/** Texels of a splat in the texture of geometry. */
const GEOMETRY_TEXELS = 2;
/** Largest accepted body, bytes: a body is held in memory twice while it is decoded. */
const BODY_BYTES_MAX = 2 ** 30;
/** SPZ's axes are right, up, back; ours are those of the PLY. So y and z change sign. */
const AXIS_SIGNS = [1, -1, -1];

/**
 * Decodes a whole file. Throws an Error with one line of text if it is not one.
 *
 * Returns `{count, degree, positions, radii, geometry, harmonics}`: positions (xyz) and radii (three standard deviations
 * along the longest axis) as floats in the model's unit, and two arrays of 32-bit integers for textures of four integers
 * a texel. A splat has two texels of geometry: the three floats of its position, a word with the bytes of its
 * scales and opacity, two words with its quaternion xyzw as 16-bit numbers, a word with its colour, and an empty word.
 * Its harmonics above degree 0 are one byte each, in the order of the file.
 */
async function decodeSpz(file) {
  const bytes = await gunzip(file);
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (bytes.length < 16 || view.getUint32(0, true) !== 0x5053474e) throw new Error('The model is not an SPZ file.');
  const version = view.getUint32(4, true);
  const [count, degree, fractionBits] = [view.getUint32(8, true), bytes[12], bytes[13]];
  if ((version !== 2 && version !== 3) || degree > 3 || fractionBits > 23) {
    throw new Error(`The model is SPZ of version ${version}; this viewer reads versions 2 and 3.`);
  }
  const quatBytes = version === 2 ? 3 : 4;
  const harmonicBytes = 3 * ((degree + 1) ** 2 - 1);
  if (bytes.length < 16 + count * (16 + quatBytes + harmonicBytes)) throw new Error('The model was cut short; reload the page.');
  let at = 16;
  const part = (each) => bytes.subarray(at, (at += each * count));
  const parts = [part(9), part(1), part(3), part(3), part(quatBytes), part(harmonicBytes)];
  return pack({ count, degree, fractionBits, quatBytes, harmonicBytes }, parts);
}

async function gunzip(file) {
  let total = 0;
  const chunks = [];
  const reader = new Blob([file]).stream().pipeThrough(new DecompressionStream('gzip')).getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    total += value.length;
    if (total > BODY_BYTES_MAX) throw new Error('The model is too large for this viewer.');
    chunks.push(value);
  }
  const bytes = new Uint8Array(total);
  let at = 0;
  for (const chunk of chunks) {
    bytes.set(chunk, at);
    at += chunk.length;
  }
  return bytes;
}

function pack(header, [positionBytes, opacities, colors, scales, quats, sh]) {
  const { count, degree, fractionBits, quatBytes, harmonicBytes } = header;
  const rows = Math.max(1, Math.ceil(count / SPLATS_PER_ROW));
  const harmonicTexels = Math.ceil(harmonicBytes / 16);
  const positions = new Float32Array(3 * count);
  const radii = new Float32Array(count);
  const geometry = new Uint32Array(4 * GEOMETRY_TEXELS * SPLATS_PER_ROW * rows);
  const floats = new Float32Array(geometry.buffer);
  const harmonics = new Uint8Array(16 * harmonicTexels * SPLATS_PER_ROW * rows);
  const unit = 2 ** -fractionBits;
  const quat = new Float32Array(4);
  for (let i = 0; i < count; i++) {
    const texel = 4 * GEOMETRY_TEXELS * i;
    for (let k = 0; k < 3; k++) {
      const b = 9 * i + 3 * k;
      // The shifts extend the sign, which is in the highest of the three bytes.
      const fixed = ((positionBytes[b] << 8) | (positionBytes[b + 1] << 16) | (positionBytes[b + 2] << 24)) >> 8;
      positions[3 * i + k] = floats[texel + k] = fixed * unit * AXIS_SIGNS[k];
    }
    const s = 3 * i;
    radii[i] = 3 * Math.exp(Math.max(scales[s], scales[s + 1], scales[s + 2]) / 16 - 10);
    geometry[texel + 3] = scales[s] | (scales[s + 1] << 8) | (scales[s + 2] << 16) | (opacities[i] << 24);
    unpackQuat(quats, quatBytes * i, quatBytes, quat);
    geometry[texel + 4] = snorm(quat[0]) | (snorm(quat[1]) << 16);
    geometry[texel + 5] = snorm(quat[2]) | (snorm(quat[3]) << 16);
    geometry[texel + 6] = colors[s] | (colors[s + 1] << 8) | (colors[s + 2] << 16);
    const from = harmonicBytes * i;
    for (let k = 0; k < harmonicBytes; k++) harmonics[16 * harmonicTexels * i + k] = sh[from + k];
  }
  return { count, degree, positions, radii, geometry, harmonics: new Uint32Array(harmonics.buffer) };
}

function snorm(value) {
  return Math.round(Math.max(-1, Math.min(1, value)) * 32767) & 0xffff;
}

/** Unpacks a quaternion, xyzw, as spz.rs does. In four bytes its largest component is left out. */
function unpackQuat(bytes, at, length, q) {
  let dropped = 3;
  if (length === 4) {
    let bits = (bytes[at] | (bytes[at + 1] << 8) | (bytes[at + 2] << 16) | (bytes[at + 3] << 24)) >>> 0;
    dropped = bits >>> 30;
    for (let i = 3; i >= 0; i--) {
      if (i === dropped) continue;
      const size = ((bits & 511) / 511) * Math.SQRT1_2;
      q[i] = (bits >>> 9) & 1 ? -size : size;
      bits >>>= 10;
    }
  } else {
    for (let i = 0; i < 3; i++) q[i] = bytes[at + i] / 127.5 - 1;
  }
  q[dropped] = 0;
  q[dropped] = Math.sqrt(Math.max(0, 1 - (q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)));
  q[1] *= AXIS_SIGNS[1];
  q[2] *= AXIS_SIGNS[2];
}

/** The bytes of a text in base64, as a report embeds its model. */
function bytesOfBase64(text) {
  const binary = atob(text.trim());
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}
