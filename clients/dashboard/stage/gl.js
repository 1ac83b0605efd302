/** The few features of WebGL 2 that the stage and the phylogeny need. */

/**
 * A program with uniforms that are found by name. It compiles in the background. Only its first use
 * waits for that, and throws the compiler's message if it fails.
 */
export class Program {
  /**
   * @param {WebGL2RenderingContext} gl
   * @param {string[]} sources of the vertex and the fragment shader
   */
  constructor(gl, sources) {
    this.gl = gl;
    this.sources = sources;
    this.handle = null;
    this.places = null;
  }

  /** Starts to compile, without waiting. */
  prepare() {
    const { gl, sources: [vertexSource, fragmentSource] } = this;
    this.handle = gl.createProgram();
    this.#attach(gl.VERTEX_SHADER, vertexSource);
    this.#attach(gl.FRAGMENT_SHADER, fragmentSource);
    gl.linkProgram(this.handle);
    return this;
  }

  /** Waits for the compiler, if it has started: later, this would wait for drawings, too. */
  await() {
    if (this.handle && !this.places) this.#finish();
  }

  #finish() {
    const { gl } = this;
    if (!this.handle) this.prepare();
    if (!gl.getProgramParameter(this.handle, gl.LINK_STATUS) && !gl.isContextLost()) {
      const logs = gl.getAttachedShaders(this.handle).map((shader) => gl.getShaderInfoLog(shader));
      throw new Error(
        `A shader failed to compile: ${gl.getProgramInfoLog(this.handle)} ${logs.join(' ')}`);
    }
    this.places = new Map();
    this.units = 0;
    const n = gl.getProgramParameter(this.handle, gl.ACTIVE_UNIFORMS) ?? 0;
    for (let i = 0; i < n; i++) {
      const { name, type } = gl.getActiveUniform(this.handle, i);
      this.places.set(name, { at: gl.getUniformLocation(this.handle, name), type });
    }
  }

  #attach(type, source) {
    const { gl } = this;
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(this.handle, shader);
  }

  /** Makes this the current program. */
  use() {
    if (!this.places) this.#finish();
    this.gl.useProgram(this.handle);
    this.units = 0;
    return this;
  }

  /**
   * Sets uniforms by name; a texture takes the next free unit. Names that the program lacks are
   * skipped, and so are values that are already set. Arrays are compared as objects, so do not
   * change an array after it was set.
   */
  set(values) {
    const { gl } = this;
    for (const [name, value] of Object.entries(values)) {
      const place = this.places.get(name);
      if (!place || place.value === value) continue;
      if (!place.isTexture) place.value = value;
      switch (place.type) {
        case gl.FLOAT: gl.uniform1f(place.at, value); break;
        case gl.FLOAT_VEC2: gl.uniform2fv(place.at, value); break;
        case gl.FLOAT_VEC3: gl.uniform3fv(place.at, value); break;
        case gl.FLOAT_VEC4: gl.uniform4fv(place.at, value); break;
        case gl.FLOAT_MAT4: gl.uniformMatrix4fv(place.at, false, value); break;
        case gl.BOOL: case gl.INT: gl.uniform1i(place.at, value ? Number(value) : 0); break;
        default:
          place.isTexture = true; // other programs bind theirs to the same unit
          place.value = undefined;
          place.unit ??= this.units;
          this.units = Math.max(this.units, place.unit + 1);
          gl.activeTexture(gl.TEXTURE0 + place.unit);
          gl.bindTexture(gl.TEXTURE_2D, value);
          gl.uniform1i(place.at, place.unit);
      }
    }
    return this;
  }
}

let software;
/** A canvas that is ready to be drawn on in software, where making a context takes long. */
let spareCanvas = null;

/** Returns a canvas for a stage. */
export function stageCanvas() {
  isSoftware();
  const canvas = spareCanvas ?? document.createElement('canvas');
  spareCanvas = null;
  return canvas;
}

/** Returns the context of a stage. */
export const stageContext = (canvas, antialias) =>
  canvas.getContext('webgl2', { antialias, alpha: false, preserveDrawingBuffer: true });

/** Returns whether the browser draws without a graphics processor. */
export function isSoftware() {
  if (software === undefined) {
    // The result decides how contexts are made. Without a graphics processor, this canvas can be
    // used.
    const canvas = document.createElement('canvas');
    const gl = stageContext(canvas, false);
    const about = gl?.getExtension('WEBGL_debug_renderer_info');
    const name = gl?.getParameter(about ? about.UNMASKED_RENDERER_WEBGL : gl.RENDERER) ?? '';
    software = /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
    if (software) spareCanvas = canvas;
    else gl?.getExtension('WEBGL_lose_context')?.loseContext();
  }
  return software;
}

/** Creates a texture of numbers, read by texelFetch. */
export function dataTexture(gl, internal, width, height, format, type, data) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, data);
  for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
    gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
  }
  for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) {
    gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
  }
  return texture;
}

/**
 * Creates a vertex array for one interleaved or packed buffer.
 * @param {{at: number, size: number, type: number, integer?: boolean, stride: number,
 *          offset?: number, divisor?: number}[]} attributes
 */
export function vertexArray(gl, data, attributes) {
  const array = gl.createVertexArray();
  const buffer = gl.createBuffer();
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
  for (const { at, size, type, integer, stride, offset = 0, divisor = 0 } of attributes) {
    gl.enableVertexAttribArray(at);
    if (integer) gl.vertexAttribIPointer(at, size, type, stride, offset);
    else gl.vertexAttribPointer(at, size, type, false, stride, offset);
    gl.vertexAttribDivisor(at, divisor);
  }
  gl.bindVertexArray(null);
  return { array, buffer, free: () => { gl.deleteVertexArray(array); gl.deleteBuffer(buffer); } };
}

/** Creates a depth map as seen from the sun. */
export function shadowTarget(gl, size) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, size, size);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
  for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) {
    gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
  }
  const frame = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, texture, 0);
  gl.drawBuffers([gl.NONE]);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  return { texture, frame, size };
}
