// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// The WebSocket to the server; comes back by itself.

import {decode} from './decoder.js';

const FIRST_RETRY_MS = 300, LAST_RETRY_MS = 3000;
const FULL = 1013, REFUSED = 1008;

export class Connection {
  // handlers: picture({sequence, stamp_ns, orientation, image}), state(…), notice(…),
  // open(), closed(reason), and maxColumns(), that the image may have.
  constructor(handlers) {
    this.handlers = handlers;
    this.retryMs = FIRST_RETRY_MS;
    this.#open();
  }

  // Sends a command; false where there is no connection.
  send(type, values = {}) {
    if (this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify({type, ...values}));
    return true;
  }

  #open() {
    const url = new URL('socket' + location.search, location.href);
    url.protocol = url.protocol === 'https:' ? 'wss:' : 'ws:';
    const socket = this.socket = new WebSocket(url);
    const decoder = new PictureDecoder(picture => {
      if (socket === this.socket) this.handlers.picture(picture);
    }, this.handlers.maxColumns);
    socket.binaryType = 'arraybuffer';
    socket.onopen = () => this.handlers.open();
    socket.onmessage = ({data}) => {
      this.retryMs = FIRST_RETRY_MS;
      if (typeof data !== 'string') {
        decoder.take(data);
        return;
      }
      const message = JSON.parse(data);
      this.handlers[message.type](message);
    };
    socket.onclose = ({code, reason}) => {
      this.handlers.closed(code === FULL ? 'All places are taken: close the page elsewhere.'
        : code === REFUSED ? `The server refused this page: ${reason}.` : '');
      setTimeout(() => this.#open(), this.retryMs);
      this.retryMs = Math.min(2 * this.retryMs, LAST_RETRY_MS);
    };
  }
}

// Decodes one picture at a time; of those that come meanwhile only the newest counts.
class PictureDecoder {
  constructor(done, maxColumns) {
    Object.assign(this, {done, maxColumns});
    this.next = null;
    this.busy = false;
  }

  async take(message) {
    this.next = message;
    if (this.busy) return;
    this.busy = true;
    while (this.next) {
      const [header, file] = parsed(this.next);
      this.next = null;
      // A broken file is a picture without an image.
      const image = await decode(file, this.maxColumns()).catch(() => null);
      this.done({...header, image});
    }
    this.busy = false;
  }
}

function parsed(message) {
  const length = new DataView(message).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(message, 4, length)));
  return [header, new Uint8Array(message, 4 + length)];
}
