// Draws a model with WebGL 2. Splats are blended from back to front into floating-point textures, and a second pass puts
// them on the screen. It knows nothing about input and the page.
//
// Start reading at Drawing.draw. A camera is `{rotation, translation, focal_px, center_px, size_px}`: rotation (nine
// numbers, row by row) and translation are cam_from_world; x is right, y down, z forward; the centre of the first pixel is
// at (0.5, 0.5).

/* exported Drawing, eyeOf, LAYERS */

/** The layers by their number in the shader. */
const LAYERS = ['colour', 'depth', 'normal'];

/** The camera's centre in the world. */
function eyeOf({ rotation: r, translation: t }) {
  return [0, 1, 2].map((k) => -(r[k] * t[0] + r[3 + k] * t[1] + r[6 + k] * t[2]));
}

/** The camera as the shader and the sorter need it. */
function viewOf(camera) {
  const slope = (edge) => [0, 1].map((a) => (edge * camera.size_px[a] - camera.center_px[a]) / camera.focal_px[a]);
  return {
    ...camera,
    eye: eyeOf(camera),
    near: NEAR,
    slopeMin: slope(-LINEARISATION_MARGIN),
    slopeMax: slope(1 + LINEARISATION_MARGIN),
  };
}

/** A linked program with the places of its uniforms. */
function programOf(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    gl.deleteShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(`A shader failed: ${gl.getShaderInfoLog(shader)}`);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(`The shaders failed: ${gl.getProgramInfoLog(program)}`);
  const at = {};
  for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(program, i);
    at[name] = gl.getUniformLocation(program, name);
  }
  return { program, at };
}

/** A model on the graphics card, drawn to a canvas. Throws an Error with one line of text if the browser cannot do it. */
class Drawing {
  constructor(canvas, model) {
    const gl = canvas.getContext('webgl2', { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error('This browser has no WebGL 2, which the model needs; open the page in a current browser.');
    [this.gl, this.canvas] = [gl, canvas];
    // Eight bits lose faint splats, and sixteen lose centimetres of depth. Not every browser blends 32 bits.
    this.isFloat = Boolean(gl.getExtension('EXT_color_buffer_float'));
    this.isFull = this.isFloat && Boolean(gl.getExtension('EXT_float_blend'));
    this.programs = {
      color: programOf(gl, SPLAT_VERTEX, SPLAT_FRAGMENT(false)),
      geometry: programOf(gl, SPLAT_VERTEX, SPLAT_FRAGMENT(true)),
      screen: programOf(gl, SCREEN_VERTEX, SCREEN_FRAGMENT),
    };
    [this.targets, this.textures] = [{}, []];
    this.takeModel(model);
  }

  /** Draws this model from now on, without an empty picture in between: it is sorted for a camera first. */
  async replaceModel(model, camera) {
    const sorter = new Sorter(model.positions, model.radii);
    const sorted = await sorter.sort(viewOf(camera));
    this.takeModel(model, sorter);
    this.takeOrder(sorted);
  }

  /** Draws this model from now on. */
  takeModel(model, sorter = new Sorter(model.positions, model.radii)) {
    this.sorter?.end();
    this.sorter = sorter;
    this.textures.splice(0).forEach((texture) => this.gl.deleteTexture(texture));
    [this.degree, this.count, this.range, this.rows] = [model.degree, 0, [1, 2], Math.max(1, Math.ceil(model.count / SPLATS_PER_ROW))];
    this.paint = null;
    this.upload(model);
  }

  /** Puts the model into textures. */
  upload({ count, degree, geometry, harmonics }) {
    const gl = this.gl;
    const rows = Math.max(1, Math.ceil(count / SPLATS_PER_ROW));
    if (rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error(`The model has ${count} splats, too many for this graphics card.`);
    const texture = (unit, width, texels) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      this.textures.push(gl.createTexture());
      gl.bindTexture(gl.TEXTURE_2D, this.textures.at(-1));
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, width, texels ? rows : 1, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, texels);
    };
    texture(0, GEOMETRY_TEXELS * SPLATS_PER_ROW, geometry);
    texture(1, degree ? degree * SPLATS_PER_ROW : 1, degree ? harmonics : null);
    this.vertices = gl.createVertexArray();
    gl.bindVertexArray(this.vertices);
    this.order = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    gl.bindVertexArray(null);
  }

  /** Draws the splats in these colours from now on, a texel for each splat; in their own colours if there are none. */
  takePaint(texels) {
    const gl = this.gl;
    if (this.paint) gl.deleteTexture(this.paint);
    this.paint = texels && gl.createTexture();
    if (!texels) return;
    gl.activeTexture(gl.TEXTURE4);
    gl.bindTexture(gl.TEXTURE_2D, this.paint);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, SPLATS_PER_ROW, this.rows, 0, gl.RGBA, gl.UNSIGNED_BYTE, texels);
  }

  /** Sorts the splats for a camera. Resolves to false if a newer camera took the place of this one. */
  async sort(camera) {
    const sorted = await this.sorter.sort(viewOf(camera));
    if (!sorted) return false;
    this.takeOrder(sorted);
    return true;
  }

  takeOrder({ order, range }) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    [this.count, this.range] = [order.length, range];
  }

  /** Draws a layer to the canvas, which takes the camera's size. The splats are in the order of the last sort. */
  draw(camera, layer = 0) {
    const { gl, canvas } = this;
    const [width, height] = camera.size_px;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    this.blend(camera, layer !== 0);
    const { program, at } = this.programs.screen;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.BLEND);
    gl.useProgram(program);
    gl.viewport(0, 0, width, height);
    this.fit(camera.size_px, layer !== 0).textures.forEach((texture, i) => {
      gl.activeTexture(gl.TEXTURE2 + i);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    gl.uniform1i(at.u_first, 2);
    gl.uniform1i(at.u_second, 3);
    gl.uniform1i(at.u_layer, layer);
    gl.uniform2fv(at.u_range, this.range);
    for (const name of ['focal_px', 'center_px', 'size_px']) gl.uniform2fv(at[`u_${name}`], camera[name]);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** The depth of the surface at a point of the picture, px, along the optical axis; null where there is none. */
  depthAt(camera, at) {
    return this.depthsFrom(camera, at, 1)[0];
  }

  /** The same at this number of pixels in a row, from a point of the picture to the right. */
  depthsFrom(camera, [x, y], count) {
    const gl = this.gl;
    const area = [Math.floor(x), camera.size_px[1] - 1 - Math.floor(y), count, 1];
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(...area);
    this.blend(camera, true);
    gl.disable(gl.SCISSOR_TEST);
    const [first, second] = [0, 1].map((i) => {
      const [floats, bytes] = [new Float32Array(4 * count), new Uint8Array(4 * count)];
      gl.readBuffer(gl.COLOR_ATTACHMENT0 + i);
      if (this.isFloat) gl.readPixels(...area, gl.RGBA, gl.FLOAT, floats);
      else gl.readPixels(...area, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
      return floats;
    });
    gl.readBuffer(gl.COLOR_ATTACHMENT0);
    const depth = (i) => {
      const ray = [x + i, y].map((v, a) => (v - camera.center_px[a]) / camera.focal_px[a]);
      const [a, b, c, alpha] = first.subarray(4 * i, 4 * i + 4);
      const facing = -(a * ray[0] + b * ray[1] + c);
      return alpha < 0.5 || facing < 0.01 * alpha ? null : second[4 * i] / facing;
    };
    return Array.from({ length: count }, (_, i) => depth(i));
  }

  /** Blends the splats into the textures of the camera's size. */
  blend(camera, geometry) {
    const gl = this.gl;
    const view = viewOf(camera);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.fit(camera.size_px, geometry).framebuffer);
    gl.drawBuffers(geometry ? [gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1] : [gl.COLOR_ATTACHMENT0]);
    gl.viewport(0, 0, ...camera.size_px);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    const { program, at } = geometry ? this.programs.geometry : this.programs.color;
    gl.useProgram(program);
    gl.uniform1i(at.u_geometry, 0);
    gl.uniform1i(at.u_harmonics, 1);
    gl.uniform1i(at.u_degree, this.degree);
    if (at.u_paint) gl.uniform1i(at.u_paint, 4);
    if (at.u_is_painted) gl.uniform1i(at.u_is_painted, this.paint ? 1 : 0);
    gl.uniformMatrix3fv(at.u_rotation, true, camera.rotation);
    gl.uniform3fv(at.u_translation, camera.translation);
    gl.uniform3fv(at.u_eye, view.eye);
    for (const name of ['focal_px', 'center_px', 'size_px']) gl.uniform2fv(at[`u_${name}`], camera[name]);
    gl.uniform2fv(at.u_slope_min, view.slopeMin);
    gl.uniform2fv(at.u_slope_max, view.slopeMax);
    gl.bindVertexArray(this.vertices);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
    gl.bindVertexArray(null);
  }

  /** The framebuffer and textures that splats are blended into, made anew if the size has changed. */
  fit([width, height], geometry) {
    const gl = this.gl;
    const name = geometry ? 'geometry' : 'color';
    const known = this.targets[name];
    if (known?.width === width && known.height === height) return known;
    known?.textures.forEach((texture) => gl.deleteTexture(texture));
    if (known) gl.deleteFramebuffer(known.framebuffer);
    const framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    const format = !this.isFloat ? gl.RGBA8 : geometry && this.isFull ? gl.RGBA32F : gl.RGBA16F;
    const textures = (geometry ? [0, 1] : [0]).map((i) => {
      const texture = gl.createTexture();
      gl.activeTexture(gl.TEXTURE2 + i);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, texture, 0);
      return texture;
    });
    this.targets[name] = { width, height, framebuffer, textures };
    return this.targets[name];
  }
}
