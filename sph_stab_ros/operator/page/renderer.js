// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

import {SoftwareRenderer} from './software_renderer.js';
import {SphereRenderer} from './sphere_renderer.js';

const WITHOUT_CARD = /swiftshader|llvmpipe|softpipe|software|basic render/i;

// Returns what draws on a canvas: by WebGL where there is a graphics card, or as the address says
// with ?renderer=webgl or software.
export function rendererFor(canvas) {
  const wanted = new URLSearchParams(location.search).get('renderer')
    ?? (hasGraphicsCard() ? 'webgl' : 'software');
  return wanted === 'webgl' ? new SphereRenderer(canvas) : new SoftwareRenderer(canvas);
}

function hasGraphicsCard() {
  const gl = document.createElement('canvas').getContext('webgl2');
  if (!gl) return false;
  const info = gl.getExtension('WEBGL_debug_renderer_info');
  const name = gl.getParameter(info?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER);
  gl.getExtension('WEBGL_lose_context')?.loseContext();
  return !WITHOUT_CARD.test(name);
}
