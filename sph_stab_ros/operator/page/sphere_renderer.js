// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// Draws a perspective view of an equirectangular picture with WebGL 2: a globe of flat facets with
// the picture on it, seen from its centre. A facet of 2.8° is not off by more than 0.02°.

import {programOf} from './webgl.js';

const COLUMNS = 128, ROWS = 64;
const DARK = 16;
// How many pictures the card may draw black that are not; in a headset nobody can look.
const TRIALS = 3;

const VERTEX_SHADER = `#version 300 es
const float PI = 3.14159265358979;
uniform mat3 R_camera_view;
uniform vec4 lens;  // see drawInto
out vec2 place;
void main() {
  // A strip of triangles for each row of facets.
  place = vec2(gl_VertexID >> 1, gl_InstanceID + (gl_VertexID & 1)) / vec2(${COLUMNS}, ${ROWS});
  float lon = (place.x - 0.5) * 2.0 * PI, lat = (0.5 - place.y) * PI;
  vec3 x_camera = vec3(cos(lat) * sin(lon), -sin(lat), cos(lat) * cos(lon));
  vec3 x = x_camera * R_camera_view;  // from the left: by its inverse
  gl_Position = vec4(lens.x * x.x - lens.z * x.z, -lens.y * x.y - lens.w * x.z, 0, x.z);
}`;

const FRAGMENT_SHADER = `#version 300 es
precision highp float;
uniform sampler2D sphere, cb, cr;  // luma and chroma where planar
uniform bool planar;
in vec2 place;
out vec4 colour;
void main() {
  colour = texture(sphere, place);
  if (planar) {  // JFIF's colours
    float b = texture(cb, place).r - 0.50196, r = texture(cr, place).r - 0.50196;
    colour = vec4(colour.r + vec3(1.402 * r, -0.344136 * b - 0.714136 * r, 1.772 * b), 1);
  }
}`;

export class SphereRenderer {
  // failed(reason): called where the context is lost. Throws an Error where the browser cannot do it,
  // as do the methods where it fails. xrCompatible: whether a headset is to show it.
  constructor(canvas, failed = () => {}, xrCompatible = false) {
    Object.assign(this, {canvas, allowance: xrCompatible ? 0 : TRIALS});
    this.gl = canvas.getContext(
      'webgl2', {alpha: false, antialias: false, depth: false, xrCompatible});
    if (!this.gl) throw new Error('This browser has no WebGL 2.');
    this.slow = false;
    this.maxColumns = this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE);
    canvas.addEventListener('webglcontextlost', () => failed('The graphics card was taken away.'));
    this.#prepare();
    this.#check();
  }

  #prepare() {
    const gl = this.gl;
    const program = this.program = programOf(gl, VERTEX_SHADER, FRAGMENT_SHADER);
    gl.useProgram(program);
    this.rotation = gl.getUniformLocation(program, 'R_camera_view');
    this.lens = gl.getUniformLocation(program, 'lens');
    this.planar = gl.getUniformLocation(program, 'planar');
    ['sphere', 'cb', 'cr'].forEach((name, unit) => {
      gl.uniform1i(gl.getUniformLocation(program, name), unit);
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.REPEAT);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    });
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    this.width = this.height = this.trials = 0;
  }

  // Takes over an image: see ``decode``. Throws an Error where that cannot be shown, and leaves it.
  load(image) {
    const gl = this.gl;
    const {width, height} = image;
    if (width > this.maxColumns) {
      throw new Error(`The graphics card takes ${this.maxColumns} columns, not ${width}.`);
    }
    gl.useProgram(this.program);
    gl.uniform1i(this.planar, Boolean(image.planes));
    if (image.planes) {
      image.planes.forEach(({data, width, height, stride}, unit) => {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.pixelStorei(gl.UNPACK_ROW_LENGTH, stride);
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.R8, width, height, 0, gl.RED, gl.UNSIGNED_BYTE, data);
      });
      gl.pixelStorei(gl.UNPACK_ROW_LENGTH, 0);
    } else {
      gl.activeTexture(gl.TEXTURE0);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
    }
    if (width !== this.width || height !== this.height) {
      // Memory may be short. To ask more often takes time.
      this.#check();
      Object.assign(this, {width, height, trials: this.allowance});
    }
    // What is black proves nothing.
    this.onTrial = this.trials > 0 && !isBlack(image);
    image.close();
  }

  // Draws what lies along R_camera_view (9, by columns); fov in radians is that of the longer side.
  // Tells whether there is something to see.
  draw(R_camera_view, fov) {
    const {width, height} = this.canvas;
    if (!this.width || !width || !height) return false;
    const perPixel = Math.tan(fov / 2) / Math.max(width, height);
    this.drawInto({x: 0, y: 0, width, height},
                  [1 / (width * perPixel), 1 / (height * perPixel), 0, 0], R_camera_view);
    return !this.onTrial || this.#drewSomething(width, height);
  }

  // Draws into a rectangle, {x, y, width, height}, of whatever framebuffer is bound. The lens is of
  // OpenGL's projection: its elements 0 and 5, by which tangents become places within −1 and 1, and
  // 8 and 9, by which its axis is off the middle.
  drawInto({x, y, width, height}, lens, R_camera_view) {
    const gl = this.gl;
    gl.useProgram(this.program);
    gl.viewport(x, y, width, height);
    gl.uniform4fv(this.lens, lens);
    gl.uniformMatrix3fv(this.rotation, false, R_camera_view);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 2 * (COLUMNS + 1), ROWS);
  }

  #check() {
    const error = this.gl.getError();
    if (error) throw new Error(`The graphics card fails (WebGL error ${error}).`);
  }

  // Some drivers draw nothing and call that no error.
  #drewSomething(width, height) {
    const gl = this.gl, row = new Uint8Array(4 * width);
    gl.readPixels(0, height >> 1, width, 1, gl.RGBA, gl.UNSIGNED_BYTE, row);
    this.#check();
    this.onTrial = false;
    const seen = row.some((value, n) => n % 4 !== 3 && value > 0);
    this.trials = seen ? 0 : this.trials - 1;
    if (!seen && !this.trials) throw new Error('The graphics card draws nothing.');
    return seen;
  }
}

// Whether there is nothing to see in an image of ``decode``.
function isBlack(image) {
  if (image.planes) {
    const {data, stride, width, height} = image.planes[0];
    for (let row = 0; row < height; row += 8) {
      for (let column = 0; column < width; column += 8) {
        if (data[row * stride + column] > DARK) return false;
      }
    }
    return true;
  }
  const context = new OffscreenCanvas(64, 32).getContext('2d');
  context.drawImage(image, 0, 0, 64, 32);
  return context.getImageData(0, 0, 64, 32).data.every((value, n) => n % 4 === 3 || value <= DARK);
}
