// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// What the operator asks the robot for, or why that would be in vain.

import {showNotice, showState} from './panels.js';

const NO_CONTROL = {
  none: 'No connection.',
  free: 'Nobody steers: take control first.',
  taken: 'Another operator steers: take control first.',
};

export class Commands {
  // state: the page's. send(command, values): tells whether there is a connection.
  constructor(state, send) {
    Object.assign(this, {state, send});
  }

  reset() {
    this.#ask('reset_heading', this.state.robot?.can_reset);
  }

  level() {
    this.#ask('level', this.state.robot?.can_level);
  }

  // Begins to record, or ends that.
  record() {
    this.#ask('record', true, {on: !this.state.recording});
  }

  setMode(mode) {
    const {state} = this;
    if (this.#ask('set_mode', state.robot?.modes.length, {mode})) state.wantedMode = mode;
    showState(state);
  }

  nextMode() {
    const {modes, mode} = this.state.robot ?? {modes: []};
    this.setMode(modes[(modes.indexOf(this.state.wantedMode ?? mode) + 1) % modes.length]);
  }

  take() {
    if (!this.send('take_control')) showNotice(NO_CONTROL.none, false);
    this.state.moved = true;
  }

  // Tells whether it has asked.
  #ask(command, possible, values) {
    const {state} = this;
    if (state.control === 'yours' && possible) return this.send(command, values);
    showNotice(state.control !== 'yours' ? NO_CONTROL[state.control]
      : state.robot?.tracking ? 'This stabilizer does not offer that.'
        : 'The stabilizer does not answer.', false);
    return false;
  }
}
