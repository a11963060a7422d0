// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// The heading scale and the attitude dial, as SVG in the page's own colours.

import {wrapped} from './rotation.js';

const SVG = 'http://www.w3.org/2000/svg';
const PX_PER_DEG = 3.6, TAPE_HEIGHT = 40, TICK_DEG = 10;
// At both ends, see style.css, and half a pointer.
const FADED_PX = 24 + 7;
const DIAL_PX_PER_DEG = 0.8, DIAL_RADIUS = 54, MAX_PITCH_DEG = 40;

function element(name, attributes, parent, text = '') {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  return parent.appendChild(made);
}

function signed(degrees) {
  const whole = Math.round(degrees);
  return `${whole > 0 ? '+' : whole < 0 ? '−' : ''}${Math.abs(whole)}°`;
}

// Where the view looks, and where the robot does: degrees to the right of the world's ahead.
export class HeadingTape {
  constructor(box) {
    this.box = box;
    this.svg = box.querySelector('svg');
    this.output = box.querySelector('output');
    // Twice round, so that it goes on to both sides of every heading.
    this.scale = element('g', {}, this.svg);
    for (let angle = -360; angle < 360; angle += TICK_DEG) {
      const labelled = angle % 30 === 0;
      const tick = element('g', {class: angle % 90 === 0 ? 'main' : '',
                                 transform: `translate(${angle * PX_PER_DEG})`}, this.scale);
      element('path', {d: `M0 ${labelled ? 14 : 18}V24`}, tick);
      if (labelled) element('text', {y: 36}, tick, (angle + 360) % 360);
    }
    this.robot = element('g', {class: 'robot'}, this.svg);
    element('path', {d: 'M0 1 7 12H-7z'}, this.robot);
    element('path', {class: 'needle', d: 'M0 12V26'}, this.svg);
    new ResizeObserver(() => this.#resize()).observe(box);
    this.heading = this.robotHeading = 0;
    this.#resize();
  }

  #resize() {
    const rem = parseFloat(getComputedStyle(document.documentElement).fontSize);
    this.width = Math.max(1, this.svg.clientWidth) * 16 / rem;
    this.svg.setAttribute('viewBox', `${-this.width / 2} 0 ${this.width} ${TAPE_HEIGHT}`);
    this.show(this.heading, this.robotHeading);
  }

  show(heading, robotHeading) {
    [this.heading, this.robotHeading] = [heading, robotHeading];
    const end = this.width / 2;
    const shift = -wrapped(heading) * PX_PER_DEG;
    this.scale.setAttribute('transform', `translate(${shift.toFixed(1)})`);
    const x = wrapped(robotHeading - heading) * PX_PER_DEG;
    const beyond = Math.abs(x) > end - FADED_PX ? Math.sign(x) : 0;
    // At the end of the scale it points to the shorter way.
    this.robot.setAttribute('transform', beyond
      ? `translate(${beyond * (end - FADED_PX)} 7) rotate(${90 * beyond}) translate(0 -7)`
      : `translate(${x.toFixed(1)})`);
    this.output.textContent = `${String(((Math.round(heading) % 360) + 360) % 360)
      .padStart(3, '0')}°`;
  }

  describe() {
    const right = Math.round(wrapped(this.robotHeading - this.heading));
    this.box.setAttribute('aria-label', `Heading ${this.output.textContent}; the robot looks ` + (
      right ? `${Math.abs(right)}° to the ${right > 0 ? 'right' : 'left'} of it` : 'there too'));
  }
}

// Roll and pitch of the robot's body: a figure against the horizon of a world that stands still.
export class AttitudeDial {
  constructor(figure) {
    this.figure = figure;
    this.rollText = figure.querySelector('#roll');
    this.pitchText = figure.querySelector('#pitch');
    const svg = figure.querySelector('svg');
    const clip = element('clipPath', {id: 'dial'}, svg);
    element('circle', {r: DIAL_RADIUS}, clip);
    const world = element('g', {'clip-path': 'url(#dial)'}, svg);
    element('rect', {class: 'sky', x: -60, y: -60, width: 120, height: 60}, world);
    element('rect', {class: 'ground', x: -60, y: 0, width: 120, height: 60}, world);
    for (const pitch of [-30, -20, -10, 10, 20, 30]) {
      const half = pitch % 20 ? 8 : 14;
      element('path', {class: 'ladder', d: `M${-half} ${-pitch * DIAL_PX_PER_DEG}h${2 * half}`},
              world);
    }
    element('path', {class: 'horizon', d: 'M-60 0H60'}, world);
    for (const roll of [-60, -45, -30, -20, -10, 0, 10, 20, 30, 45, 60]) {
      element('path', {class: 'ladder', d: `M0 ${-DIAL_RADIUS}v${roll % 30 ? 4 : 7}`,
                       transform: `rotate(${roll})`}, svg);
    }
    element('circle', {class: 'rim', r: DIAL_RADIUS}, svg);
    this.pointer = element('path', {class: 'robot', d: 'M0 -46l4.5 8h-9z'}, svg);
    this.body = element('g', {class: 'robot'}, element('g', {'clip-path': 'url(#dial)'}, svg));
    // Seen from behind: a deck, two wheels, a camera on a mast.
    element('path', {d: 'M-24 -4h48v7h-48zM-2 -14h4v10h-4z'}, this.body);
    element('circle', {cy: -16, r: 5}, this.body);
    element('rect', {x: -31, y: -6, width: 9, height: 16, rx: 3}, this.body);
    element('rect', {x: 22, y: -6, width: 9, height: 16, rx: 3}, this.body);
  }

  show(roll, pitch) {
    const up = Math.max(-MAX_PITCH_DEG, Math.min(MAX_PITCH_DEG, pitch)) * DIAL_PX_PER_DEG;
    const rolled = `rotate(${roll.toFixed(1)})`;
    this.body.setAttribute('transform', `translate(0 ${-up.toFixed(1)}) ${rolled}`);
    this.pointer.setAttribute('transform', rolled);
    this.rollText.textContent = signed(roll);
    this.pitchText.textContent = signed(pitch);
  }

  describe() {
    this.figure.setAttribute('aria-label', 'Attitude of the robot: roll ' +
      `${this.rollText.textContent}, pitch ${this.pitchText.textContent}`);
  }
}
