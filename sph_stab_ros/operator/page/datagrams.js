// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// A video by datagrams (WebTransport), beside the WebSocket, which has told how to get there.

import {Messages} from './error_correction.js';

// What may get lost is said again so often. After a silence it also tells the server that there is a
// way again.
const TELL_MS = 100;

export class Datagrams {
  // told: {path, sha256} of the server's. message(bytes): called for each.
  constructor({path, sha256}, message) {
    const value = Uint8Array.from(atob(sha256), one => one.charCodeAt(0));
    this.messages = new Messages(message);
    this.done = null;
    this.transport = new WebTransport(new URL(path, location.href), {
      congestionControl: 'low-latency',
      serverCertificateHashes: [{algorithm: 'sha-256', value}],
    });
    // Where it cannot be, or not any more, pictures come by the WebSocket.
    this.transport.closed.catch(() => {}).then(() => this.close());
    this.#listen().catch(() => this.close());
  }

  // Whether pictures come this way.
  get open() {
    return Boolean(this.writer);
  }

  // The number of the newest picture that has come, 0 before the first.
  get newest() {
    return this.messages.newest;
  }

  async #listen() {
    await this.transport.ready;
    const {readable, writable} = this.transport.datagrams;
    this.writer = writable.getWriter();
    this.telling = setInterval(() => this.#tell(), TELL_MS);
    const reader = readable.getReader();
    for (let one; !(one = await reader.read()).done;) this.messages.hear(one.value);
  }

  // Tells what became of a picture.
  send(type, values) {
    this.done = {type, ...values};
    this.#write(this.done);
  }

  #tell() {
    if (this.done) this.#write(this.done);
    const {usable, newest} = this.messages;
    this.#write({type: 'arrived', sequence: usable, newest});
  }

  #write(command) {
    this.writer.write(new TextEncoder().encode(JSON.stringify(command))).catch(() => {});
  }

  close() {
    clearInterval(this.telling);
    this.writer = null;
    try {
      this.transport.close();
    } catch {
      // It has never been open.
    }
  }
}
