// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// Draws by WebGL where there is a graphics card, and by the processor where there is none, or where
// it fails.

import {SoftwareRenderer} from './software_renderer.js';
import {SphereRenderer} from './sphere_renderer.js';

// What browsers call a graphics card that there is not.
const WITHOUT_CARD = /swiftshader|llvmpipe|softpipe|software|basic render/i;

export class Renderer {
  // place: the element that gets a canvas. fellBack(reason): called when the processor has to go on,
  // with nothing to show until the next picture. The address chooses by ?renderer=webgl or software.
  constructor(place, fellBack) {
    Object.assign(this, {place, fellBack});
    const wanted = new URLSearchParams(location.search).get('renderer')
      ?? (hasGraphicsCard() ? 'webgl' : 'software');
    if (wanted !== 'webgl') {
      this.#use(SoftwareRenderer);
      return;
    }
    try {
      this.#use(SphereRenderer);
    } catch (error) {
      this.#fallBack(error.message, this.canvas);
    }
  }

  // Whether each pixel takes its time.
  get slow() {
    return this.renderer.slow;
  }

  // How many columns a picture may have; ``decode`` makes it smaller.
  get maxColumns() {
    return this.renderer.maxColumns;
  }

  resize(width, height) {
    // Also the same numbers would clear it.
    if (width !== this.canvas.width) this.canvas.width = width;
    if (height !== this.canvas.height) this.canvas.height = height;
  }

  // Takes over an image: see ``decode``.
  load(image) {
    this.#trying(() => this.renderer.load(image));
  }

  // Draws what lies along R_camera_view (9, by columns); fov in radians is that of the longer side.
  // Tells whether there is something to see.
  draw(R_camera_view, fov) {
    return this.#trying(() => this.renderer.draw(R_camera_view, fov));
  }

  #use(Kind) {
    // One canvas is for one kind of drawing, for ever.
    const canvas = document.createElement('canvas');
    if (this.canvas) Object.assign(canvas, {width: this.canvas.width, height: this.canvas.height});
    this.renderer = new Kind(canvas, reason => this.#fallBack(reason, canvas));
    this.canvas = canvas;
    this.place.replaceChildren(canvas);
  }

  // Does it again by the processor where the card fails.
  #trying(work) {
    try {
      return work();
    } catch (error) {
      if (this.renderer instanceof SoftwareRenderer) throw error;
      this.#fallBack(error.message, this.canvas);
      return work();
    }
  }

  #fallBack(reason, canvas) {
    // One that was given up may lose its context later.
    if (canvas !== this.canvas) return;
    this.#use(SoftwareRenderer);
    this.fellBack(reason);
  }
}

function hasGraphicsCard() {
  const gl = document.createElement('canvas').getContext('webgl2');
  if (!gl) return false;
  const info = gl.getExtension('WEBGL_debug_renderer_info');
  const name = gl.getParameter(info?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER);
  gl.getExtension('WEBGL_lose_context')?.loseContext();
  return !WITHOUT_CARD.test(name);
}
