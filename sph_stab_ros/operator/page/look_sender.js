// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// Tells where the operator looks: at once, then no more often than pictures come, and the last always.

const PERIOD_MS = 33;

export class LookSender {
  // send(direction): takes a quaternion, R_virtual_view.
  constructor(send) {
    Object.assign(this, {send, sentAt: 0, timer: null});
  }

  take(direction) {
    this.direction = direction;
    this.timer ??= setTimeout(
      () => this.#send(), Math.max(0, this.sentAt + PERIOD_MS - performance.now()));
  }

  #send() {
    this.timer = null;
    this.sentAt = performance.now();
    this.send(this.direction);
  }
}
