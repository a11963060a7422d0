// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// Where the operator looks: by pointer, touch, wheel, keys and gamepad.

import {fromAngles, radians} from './rotation.js';

const FOV = radians(100), MIN_FOV = radians(20), MAX_FOV = radians(140);
// By keys and sticks: this share of the field of view per second.
const TURN_RATE = 0.7, ZOOM_RATE = 1.2;
// A short press of a key counts at least so long.
const SHORTEST_PRESS_S = 0.06;
const DEAD_ZONE = 0.15;
const KEYS = {
  ArrowLeft: [1, 0, 0], ArrowRight: [-1, 0, 0], ArrowUp: [0, 1, 0], ArrowDown: [0, -1, 0],
  '+': [0, 0, 1], '=': [0, 0, 1], '-': [0, 0, -1],
};
const GAMEPAD_ACTIONS = {0: 'centre', 2: 'before', 3: 'snapshot', 8: 'record', 9: 'reset'};

export class Look {
  // changed() is called when yaw, pitch, roll or fov (radians) have changed, press(id) for a button
  // of the gamepad.
  constructor(place, changed, press) {
    Object.assign(this, {place, changed, press, yaw: 0, pitch: 0, roll: 0, fov: FOV});
    this.pointers = new Map();
    this.held = new Map();
    this.pressedButtons = new Set();
    this.ticked = 0;
    place.addEventListener('pointerdown', event => this.#down(event));
    place.addEventListener('pointermove', event => this.#move(event));
    for (const type of ['pointerup', 'pointercancel', 'lostpointercapture']) {
      place.addEventListener(type, event => this.#up(event));
    }
    place.addEventListener('wheel', event => {
      event.preventDefault();
      const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 16 : 1;
      // A pinch on a touchpad comes as a wheel with Ctrl, in small steps.
      this.zoom(Math.exp(-event.deltaY * lines / (event.ctrlKey ? 100 : 800)));
    }, {passive: false});
    addEventListener('keydown', event => this.#keyDown(event));
    addEventListener('keyup', event => this.#keyUp(event));
    addEventListener('blur', () => this.held.clear());
    addEventListener('gamepadconnected', () => this.#start());
  }

  // R_virtual_view.
  get direction() {
    return fromAngles(this.yaw, this.pitch, this.roll);
  }

  centre() {
    this.#set(0, 0, FOV);
  }

  // Looks where somebody else has found out: a headset, or how a phone is held.
  turnTo(yaw, pitch, roll = 0) {
    this.roll = roll;
    this.#set(yaw, pitch, this.fov);
  }

  // A factor above 1 brings things closer.
  zoom(factor) {
    this.#set(this.yaw, this.pitch, 2 * Math.atan(Math.tan(this.fov / 2) / factor));
  }

  #set(yaw, pitch, fov) {
    this.yaw = yaw - 2 * Math.PI * Math.round(yaw / (2 * Math.PI));
    this.pitch = Math.max(-Math.PI / 2, Math.min(Math.PI / 2, pitch));
    this.fov = Math.max(MIN_FOV, Math.min(MAX_FOV, fov));
    this.changed();
  }

  #down(event) {
    this.place.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, event);
  }

  #up(event) {
    this.pointers.delete(event.pointerId);
  }

  // One pointer takes the world along, two also zoom.
  #move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const spread = this.#spread();
    this.pointers.set(event.pointerId, event);
    const {clientWidth, clientHeight} = this.place;
    const perPixel = 2 * Math.tan(this.fov / 2) / Math.max(clientWidth, clientHeight);
    const share = perPixel / this.pointers.size;
    const factor = spread ? this.#spread() / spread : 1;
    this.#set(this.yaw + Math.atan((event.clientX - before.clientX) * share) /
                         Math.max(Math.cos(this.pitch), 0.3),
              this.pitch + Math.atan((event.clientY - before.clientY) * share),
              2 * Math.atan(Math.tan(this.fov / 2) / factor));
  }

  // Distance in pixels between two pointers, 0 for one.
  #spread() {
    const [a, b] = this.pointers.values();
    return b ? Math.max(1, Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY)) : 0;
  }

  #keyDown(event) {
    const {key, target} = event;
    if (!(key in KEYS) || event.ctrlKey || event.altKey || event.metaKey || inUse(target)) return;
    event.preventDefault();
    if (this.held.has(key)) return;
    this.held.set(key, KEYS[key]);
    this.#start();
    this.#turn(KEYS[key], SHORTEST_PRESS_S);
  }

  #keyUp({key}) {
    this.held.delete(key);
  }

  // Turns with the display's frames while a key is held or a gamepad is there.
  #start() {
    if (this.ticked) return;
    this.ticked = performance.now();
    requestAnimationFrame(now => this.#tick(now));
  }

  #tick(now) {
    const seconds = Math.max(0, Math.min(0.1, (now - this.ticked) / 1000));
    this.ticked = now;
    const rates = [...this.held.values(), ...this.#gamepadRates()];
    if (rates.length) {
      this.#turn([0, 1, 2].map(i => rates.reduce((sum, rate) => sum + rate[i], 0)), seconds);
    }
    if (this.held.size || gamepads().length) {
      requestAnimationFrame(now => this.#tick(now));
    } else {
      this.ticked = 0;
    }
  }

  #turn([left, up, closer], seconds) {
    const angle = TURN_RATE * this.fov * seconds;
    this.#set(this.yaw + left * angle, this.pitch + up * angle,
              2 * Math.atan(Math.tan(this.fov / 2) * Math.exp(-closer * ZOOM_RATE * seconds)));
  }

  // Rates by the gamepads' sticks and triggers; calls press() for buttons that went down.
  #gamepadRates() {
    const rates = [];
    for (const pad of gamepads()) {
      const [x, y, x2, y2] = pad.axes.map(value => Math.abs(value) < DEAD_ZONE ? 0 : value);
      const rate = [-(x + x2), -(y + y2), pad.buttons[7].value - pad.buttons[6].value];
      if (rate.some(value => value)) rates.push(rate);
      for (const [button, id] of Object.entries(GAMEPAD_ACTIONS)) {
        const name = `${pad.index} ${button}`;
        if (!pad.buttons[button]?.pressed) this.pressedButtons.delete(name);
        else if (!this.pressedButtons.has(name)) {
          this.pressedButtons.add(name);
          this.press(id);
        }
      }
    }
    return rates;
  }
}

// Those whose buttons are known; some browsers give none to pages of plain http.
function gamepads() {
  const pads = navigator.getGamepads?.() ?? [];
  return [...pads].filter(pad => pad?.mapping === 'standard');
}

// Whether an element has a use of its own for keys.
export function inUse(element) {
  return element instanceof HTMLInputElement || document.querySelector('dialog[open]') !== null;
}
