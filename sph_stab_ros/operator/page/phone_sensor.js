// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// Looking around by turning the phone, as a window into the world.

import {anglesOf, multiply, radians} from './rotation.js';

const PATIENCE_MS = 1500;
const QUARTER = Math.SQRT1_2;

export const hasSensor = () =>
  Boolean(globalThis.DeviceOrientationEvent) && matchMedia('(pointer: coarse)').matches;

export class PhoneSensor {
  // turned(leftwards, pitch, roll): by how much to the left since the last call, and how the phone is
  // held against the horizon. failed(reason): why it ends by itself.
  constructor(turned, failed) {
    Object.assign(this, {turned, failed, active: false, yaw: null});
    this.listener = event => this.#take(event);
  }

  // By a click only, as some browsers ask for permission.
  async start() {
    this.active = true;
    const answer = await DeviceOrientationEvent.requestPermission?.().catch(() => 'denied');
    if (answer === 'denied') {
      this.#fail('The browser does not let this page know how the phone is turned.');
      return;
    }
    if (!this.active) return;
    this.yaw = null;
    addEventListener('deviceorientation', this.listener);
    setTimeout(() => {
      if (this.active && this.yaw === null) {
        this.#fail('This device does not tell how it is turned.');
      }
    }, PATIENCE_MS);
  }

  stop() {
    this.active = false;
    removeEventListener('deviceorientation', this.listener);
  }

  #fail(reason) {
    this.stop();
    this.failed(reason);
  }

  #take({alpha, beta, gamma}) {
    if (alpha === null || beta === null || gamma === null) return;
    const {yaw, pitch, roll} = anglesOf(lookOf(alpha, beta, gamma, screen.orientation?.angle ?? 0));
    this.turned(this.yaw === null ? 0 : yaw - this.yaw, pitch, roll);
    this.yaw = yaw;
  }
}

// Returns where the back of a phone looks, by the angles of a DeviceOrientationEvent and the screen's
// in degrees: a quaternion of a level world.
export function lookOf(alpha, beta, gamma, screenAngle) {
  const about = (axis, degrees) => {
    const half = radians(degrees) / 2;
    const quaternion = [0, 0, 0, Math.cos(half)];
    quaternion[axis] = Math.sin(half);
    return quaternion;
  };
  // The earth's axes are east, north and up, the screen's right, up and towards the eye.
  return [
    [QUARTER, 0, 0, QUARTER], about(2, alpha), about(0, beta), about(1, gamma),
    about(2, -screenAngle), [1, 0, 0, 0],
  ].reduce(multiply);
}
