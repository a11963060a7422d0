// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// Turning by a thumbstick without getting sick: in steps, which show no motion, or smoothly, behind
// a vignette that hides the motion at the edge of the eye.

import {radians} from './rotation.js';

const STEP = radians(30), RATE = radians(60);
// A step as the stick goes beyond the one, the next after it was within the other.
const PUSHED = 0.7, RELEASED = 0.3;
const DEAD_ZONE = 0.15;
// The vignette closes at once and opens gently.
const CLOSING_S = 0.1, OPENING_S = 0.4;

export class Comfort {
  constructor() {
    Object.assign(this, {smooth: false, vignette: 0, released: true});
  }

  // Takes in a stick's way to the right, −1 to 1, once for each picture of the display, and whether
  // the picture itself may be turning; returns the turn to the left in radians.
  step(stick, seconds, turning) {
    const turn = this.smooth ? this.#smoothly(stick, seconds) : this.#inSteps(stick);
    const wanted = turning || this.smooth && turn ? 1 : 0;
    const change = seconds / (wanted ? CLOSING_S : OPENING_S);
    this.vignette += Math.max(-change, Math.min(change, wanted - this.vignette));
    return turn;
  }

  #smoothly(stick, seconds) {
    return Math.abs(stick) < DEAD_ZONE ? 0 : -stick * RATE * seconds;
  }

  #inSteps(stick) {
    if (Math.abs(stick) < RELEASED) this.released = true;
    if (!this.released || Math.abs(stick) < PUSHED) return 0;
    this.released = false;
    return -Math.sign(stick) * STEP;
  }
}
