// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// What a headset shows before the world, and turns with the head: a vignette, and a sign with words.
// Both are as far away as the world, so that eyes need not squint.

import {matrix} from './rotation.js';
import {programOf} from './webgl.js';

const SEGMENTS = 64;
// From the middle of the view: where the vignette begins, where it is black, and beyond all eyes.
const RING_DEG = [26, 38, 110];
// The sign: tangents of half its width, and of how far below the middle it is. What all is well is
// not in the way of.
const CALM = [0.2, 0.46], ALARM = [0.4, 0.16];
const WIDTH = 1024, HEIGHT = 256, STRIPE = 28;
const SIGN_UNIT = 3;

const LENS = `
uniform mat3 R_eye_head;
uniform vec4 lens;
vec4 seen(vec3 x_head) {
  vec3 x = R_eye_head * x_head;
  return vec4(lens.x * x.x - lens.z * x.z, -lens.y * x.y - lens.w * x.z, 0, x.z);
}`;
const RING_VERTICES = `#version 300 es
${LENS}
uniform vec2 own;  // how black it is
out float shade;
void main() {
  // Two rings, of strips of triangles; the outer one is black throughout.
  const float edges[3] = float[3](${RING_DEG.map(deg => `radians(float(${deg}))`).join()});
  int edge = gl_InstanceID + (gl_VertexID & 1);
  float around = float(gl_VertexID >> 1) * 6.28318530718 / float(${SEGMENTS});
  shade = edge == 0 ? 0.0 : own.x;
  gl_Position = seen(vec3(sin(edges[edge]) * vec2(cos(around), sin(around)), cos(edges[edge])));
}`;
const RING_COLOUR = `#version 300 es
precision mediump float;
in float shade;
out vec4 colour;
void main() { colour = vec4(0, 0, 0, shade); }`;
const SIGN_VERTICES = `#version 300 es
${LENS}
uniform vec2 own;  // see CALM
out vec2 place;
void main() {
  place = vec2(gl_VertexID & 1, gl_VertexID >> 1);
  vec2 half_size = own.x * vec2(1, float(${HEIGHT / WIDTH}));
  gl_Position = seen(vec3((2.0 * place - 1.0) * half_size + vec2(0, own.y), 1));
}`;
const SIGN_COLOUR = `#version 300 es
precision mediump float;
uniform sampler2D sign;
in vec2 place;
out vec4 colour;
void main() { colour = texture(sign, place); }`;

export class HeadsetOverlay {
  // gl: a SphereRenderer's, which keeps its textures elsewhere.
  constructor(gl) {
    this.gl = gl;
    this.ring = this.#uniforms(programOf(gl, RING_VERTICES, RING_COLOUR));
    this.sign = this.#uniforms(programOf(gl, SIGN_VERTICES, SIGN_COLOUR));
    gl.uniform1i(gl.getUniformLocation(this.sign.program, 'sign'), SIGN_UNIT);
    gl.activeTexture(gl.TEXTURE0 + SIGN_UNIT);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    this.context = new OffscreenCanvas(WIDTH, HEIGHT).getContext('2d');
    this.shown = '';
  }

  #uniforms(program) {
    const place = name => this.gl.getUniformLocation(program, name);
    this.gl.useProgram(program);
    return {program, rotation: place('R_eye_head'), lens: place('lens'), own: place('own')};
  }

  // Changes the sign: a few words, more of them below, and whether they are an alarm.
  write({text, detail, alarm}) {
    const shown = JSON.stringify([text, detail, Boolean(alarm)]);
    if (shown === this.shown) return;
    this.shown = shown;
    this.alarm = Boolean(alarm);
    this.#paint(text, detail);
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE0 + SIGN_UNIT);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, this.context.canvas);
  }

  #paint(text, detail) {
    const {context} = this, alarm = this.alarm;
    context.clearRect(0, 0, WIDTH, HEIGHT);
    context.fillStyle = alarm ? '#ffb000' : '#111820c0';
    context.beginPath();
    context.roundRect(0, 0, WIDTH, HEIGHT, 40);
    context.fill();
    if (alarm) {
      // Seen without colour too.
      context.save();
      context.clip();
      context.strokeStyle = '#1d1300';
      context.lineWidth = STRIPE;
      for (const y of [STRIPE / 2, HEIGHT - STRIPE / 2]) {
        context.setLineDash([STRIPE, STRIPE]);
        context.strokeRect(-STRIPE, y, WIDTH + 2 * STRIPE, 0);
      }
      context.restore();
    }
    context.fillStyle = alarm ? '#1d1300' : '#f1f5f8';
    context.textAlign = 'center';
    context.textBaseline = 'middle';
    context.font = 'bold 76px system-ui, sans-serif';
    context.fillText(text, WIDTH / 2, HEIGHT * (detail ? 0.37 : 0.5), WIDTH * 0.92);
    context.font = '42px system-ui, sans-serif';
    context.fillText(detail, WIDTH / 2, HEIGHT * 0.7, WIDTH * 0.92);
  }

  // Draws both as SphereRenderer.drawInto does; the vignette with a strength of 0 to 1.
  drawInto({x, y, width, height}, lens, R_eye_head, strength) {
    const gl = this.gl;
    gl.viewport(x, y, width, height);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    if (strength > 0) {
      this.#use(this.ring, lens, R_eye_head, [strength, 0]);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 2 * (SEGMENTS + 1), 2);
    }
    this.#use(this.sign, lens, R_eye_head, this.alarm ? ALARM : CALM);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    gl.disable(gl.BLEND);
  }

  #use({program, rotation, lens: place, own}, lens, R_eye_head, values) {
    this.gl.useProgram(program);
    this.gl.uniform4fv(place, lens);
    this.gl.uniformMatrix3fv(rotation, false, matrix(R_eye_head));
    this.gl.uniform2fv(own, values);
  }
}
