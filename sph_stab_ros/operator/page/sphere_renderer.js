// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// Draws a perspective view of an equirectangular picture with WebGL 2: a globe of flat facets with
// the picture on it, seen from its centre. A facet of 2.8° is not off by more than 0.02°.

const COLUMNS = 128, ROWS = 64;

const VERTEX_SHADER = `#version 300 es
const float PI = 3.14159265358979;
uniform mat3 R_camera_view;
uniform vec2 extent;  // tangents of half the fields of view
out vec2 place;
void main() {
  // A strip of triangles for each row of facets.
  place = vec2(gl_VertexID >> 1, gl_InstanceID + (gl_VertexID & 1)) / vec2(${COLUMNS}, ${ROWS});
  float lon = (place.x - 0.5) * 2.0 * PI, lat = (0.5 - place.y) * PI;
  vec3 x_camera = vec3(cos(lat) * sin(lon), -sin(lat), cos(lat) * cos(lon));
  vec3 x = x_camera * R_camera_view;  // from the left: by its inverse
  gl_Position = vec4(x.x / extent.x, -x.y / extent.y, 0, x.z);
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
  // Throws an Error where the browser cannot do it.
  constructor(canvas) {
    const wanted = {alpha: false, antialias: false, depth: false};
    this.canvas = canvas;
    this.gl = canvas.getContext('webgl2', wanted);
    if (!this.gl) throw new Error('This browser has no WebGL 2.');
    this.slow = false;
    this.#prepare();
    canvas.addEventListener('webglcontextlost', event => event.preventDefault());
    canvas.addEventListener('webglcontextrestored', () => this.#prepare());
  }

  #prepare() {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX_SHADER],
                                  [gl.FRAGMENT_SHADER, FRAGMENT_SHADER]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error(`WebGL: ${gl.getProgramInfoLog(program)}`);
    }
    gl.useProgram(program);
    this.rotation = gl.getUniformLocation(program, 'R_camera_view');
    this.extent = gl.getUniformLocation(program, 'extent');
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
    this.width = 0;
  }

  // Takes over an image: see ``decode``.
  load(image) {
    const gl = this.gl;
    this.width = image.width;
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
    image.close();
  }

  // Draws what lies along R_camera_view (9, by columns); fov in radians is that of the longer side.
  draw(R_camera_view, fov) {
    const gl = this.gl, {width, height} = this.canvas;
    if (!this.width) return;
    gl.viewport(0, 0, width, height);
    const perPixel = Math.tan(fov / 2) / Math.max(width, height);
    gl.uniform2f(this.extent, width * perPixel, height * perPixel);
    gl.uniformMatrix3fv(this.rotation, false, R_camera_view);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 2 * (COLUMNS + 1), ROWS);
  }
}
