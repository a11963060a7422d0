// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// The world in a headset, by WebXR: drawn for each eye as often as the headset shows something,
// whatever the rate of pictures. Its horizon is level, as that of the head is; the head looks around
// without the page.

import {Comfort} from './comfort.js';
import {HeadsetOverlay} from './headset_overlay.js';
import {anglesOf, fromYawPitch, inverse, levelled, matrix, multiply} from './rotation.js';
import {SphereRenderer} from './sphere_renderer.js';

const MODE = 'immersive-vr';
// A pause is no time to turn in.
const LONGEST_S = 0.1;
// Of a controller of WebXR's standard.
const STICK_AXIS = 2, PAD_AXIS = 0;
const BUTTONS = {3: 'turning', 4: 'recentre', 5: 'level'};

export const hasHeadset = async () =>
  Boolean(await navigator.xr?.isSessionSupported(MODE).catch(() => false));

// WebXR's axes (y up, z backwards) as ours.
const rotationOf = ({orientation: {x, y, z, w}}) => [x, -y, -z, w];

// See SphereRenderer.drawInto.
const lensOf = projection => [0, 5, 8, 9].map(n => projection[n]);

export class Headset {
  // handlers: load(renderer), which gives it the newest picture and returns that or null where there
  // is no new one; drawn(picture); R_world_virtual(); looked(R_virtual_head); sign(), what
  // HeadsetOverlay.write takes and whether the picture may be turning; take() and level(), by
  // controller; ended(angles, reason) with where the head looked last and, where that is why, what
  // went wrong.
  constructor(handlers) {
    Object.assign(this, {handlers, session: null, renderer: null});
  }

  get active() {
    return this.session !== null;
  }

  // That a picture may have.
  get maxColumns() {
    return this.renderer?.maxColumns ?? Infinity;
  }

  // Begins, by a click only; the head looks along yaw then. Throws an Error where that fails.
  async enter(yaw) {
    const session = await navigator.xr.requestSession(MODE);
    session.addEventListener('end', () => this.#ended());
    session.addEventListener('select', () => this.handlers.take());
    // Not every controller has more buttons.
    session.addEventListener('squeeze', () => this.#recentre(0));
    Object.assign(this, {
      session, comfort: new Comfort(), pressed: new Set(), reason: '', shownAt: null,
      angles: {yaw, pitch: 0}, turned: 0, recentreTo: yaw,
    });
    try {
      const renderer = this.renderer = new SphereRenderer(
        document.createElement('canvas'),
        reason => { if (renderer === this.renderer) this.leave(reason); }, true);
      const {gl} = renderer;
      await gl.makeXRCompatible();
      this.overlay = new HeadsetOverlay(gl);
      this.layer = new XRWebGLLayer(session, gl, {alpha: false, antialias: false, depth: false});
      session.updateRenderState({baseLayer: this.layer});
      this.space = await session.requestReferenceSpace('local');
      // The headset's own button to recentre: its axes are others now.
      this.space.addEventListener('reset', () => this.#recentre(0));
      session.requestAnimationFrame((now, frame) => this.#frame(now, frame));
    } catch (error) {
      this.leave(error.message);
    }
  }

  leave(reason = '') {
    this.reason ||= reason;
    this.session?.end().catch(() => {});
  }

  #ended() {
    const {renderer} = this;
    Object.assign(this, {session: null, renderer: null});
    // Memory is given back now, not when somebody collects it.
    renderer?.gl.getExtension('WEBGL_lose_context')?.loseContext();
    this.handlers.ended(this.angles, this.reason);
  }

  // What is before the head gets this yaw.
  #recentre(yaw) {
    this.recentreTo = yaw;
  }

  #frame(now, frame) {
    if (!this.session) return;
    this.session.requestAnimationFrame((now, frame) => this.#frame(now, frame));
    const pose = frame.getViewerPose(this.space);
    // The headset does not know how it is held.
    if (!pose) return;
    try {
      this.#draw(pose, Math.min(LONGEST_S, (now - (this.shownAt ?? now)) / 1000));
      this.shownAt = now;
    } catch (error) {
      this.leave(error.message);
    }
  }

  #draw(pose, seconds) {
    const {renderer, overlay, layer, comfort, handlers} = this, {gl} = renderer;
    const picture = handlers.load(renderer);
    const sign = handlers.sign();
    overlay.write(sign);
    this.#pressed();
    this.turned += comfort.step(this.#stick(), seconds, sign.turning);
    const R_local_head = rotationOf(pose.transform);
    if (this.recentreTo !== null) {
      this.turned = this.recentreTo - anglesOf(R_local_head).yaw;
      this.recentreTo = null;
    }
    const R_world_virtual = handlers.R_world_virtual();
    const R_world_local = multiply(levelled(R_world_virtual), fromYawPitch(this.turned, 0));

    gl.bindFramebuffer(gl.FRAMEBUFFER, layer.framebuffer);
    gl.clear(gl.COLOR_BUFFER_BIT);
    for (const view of pose.views) {
      const viewport = layer.getViewport(view), lens = lensOf(view.projectionMatrix);
      const R_local_eye = rotationOf(view.transform);
      if (renderer.R_world_picture) {
        renderer.drawInto(viewport, lens, matrix(multiply(
          inverse(renderer.R_world_picture), multiply(R_world_local, R_local_eye))));
      }
      overlay.drawInto(viewport, lens, multiply(inverse(R_local_eye), R_local_head),
                       comfort.vignette);
    }
    if (picture) handlers.drawn(picture);
    const R_virtual_head = multiply(inverse(R_world_virtual), multiply(R_world_local, R_local_head));
    this.angles = anglesOf(R_virtual_head);
    handlers.looked(R_virtual_head);
  }

  get #gamepads() {
    return [...this.session.inputSources].map(source => source.gamepad)
      .filter(pad => pad?.mapping === 'xr-standard');
  }

  // How far sticks are to the right.
  #stick() {
    return this.#gamepads.reduce(
      (sum, {axes}) => sum + (axes[STICK_AXIS] ?? axes[PAD_AXIS] ?? 0), 0);
  }

  // Does what the buttons that have just been pressed are for.
  #pressed() {
    const before = this.pressed;
    this.pressed = new Set(this.#gamepads.flatMap(({buttons}, hand) => Object.keys(BUTTONS)
      .filter(button => buttons[button]?.pressed).map(button => `${hand} ${button}`)));
    for (const name of this.pressed) {
      if (before.has(name)) continue;
      const action = BUTTONS[name.split(' ')[1]];
      if (action === 'turning') this.comfort.smooth = !this.comfort.smooth;
      else if (action === 'recentre') this.#recentre(0);
      else this.handlers.level();
    }
  }
}
