// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// The WebSocket to the server; comes back by itself. A video comes by datagrams if it can.

import {Datagrams} from './datagrams.js';
import {decode} from './decoder.js';
import {VideoStream} from './video_stream.js';

const FIRST_RETRY_MS = 300, LAST_RETRY_MS = 1000;
// The server tells its state five times a second: a connection as silent as that is dead, also if
// nobody has closed it.
const CHECK_MS = 250, SILENT_CHECKS = 8;
// Where pictures come by datagrams they are back sooner than a new connection could be.
const SILENT_CHECKS_WITH_DATAGRAMS = 12;
// In a row, of a video; one may be of a picture.
const MAX_FAILURES = 3;
const FULL = 1013, REFUSED = 1008, FORBIDDEN = 403;
const MOVED = 'The address has changed: open the one that the operator command has printed.';
// Of pictures; what is said of a later one includes those before.
const MAY_GET_LOST = ['drawn', 'skipped'];
// Tells the server that it is we who come back, not somebody else.
const PAGE = Array.from(crypto.getRandomValues(new Uint32Array(4)), n => n.toString(36)).join('');

export class Connection {
  // handlers: picture({sequence, stamp_ns, orientation, chunk, byDatagrams, image}), state(…),
  // notice(…), echo(…), received(bytes), withoutVideo() where that fails, open(), closed(reason), and
  // maxColumns(), that the image may have. takesVideo: whether pictures may come as one.
  constructor(handlers, takesVideo) {
    this.handlers = handlers;
    this.takesVideo = takesVideo;
    this.failures = 0;
    this.retryMs = FIRST_RETRY_MS;
    this.#open();
    setInterval(() => this.#check(), CHECK_MS);
  }

  // Sends a command; false where there is no connection.
  send(type, values = {}) {
    if (this.socket?.readyState !== WebSocket.OPEN) return false;
    if (MAY_GET_LOST.includes(type) && this.datagrams?.open) {
      this.datagrams.send(type, values);
      return true;
    }
    this.socket.send(JSON.stringify({type, ...values}));
    return true;
  }

  #open() {
    const url = new URL('socket' + location.search, location.href);
    url.protocol = url.protocol === 'https:' ? 'wss:' : 'ws:';
    url.searchParams.set('page', PAGE);
    if (this.takesVideo) url.searchParams.set('video', 'h264');
    const socket = this.socket = new WebSocket(url);
    // What comes late from a connection that was given up counts no more.
    const ifCurrent = handler => event => socket === this.socket && handler(event);
    const {maxColumns} = this.handlers;
    const decoder = new PictureDecoder(ifCurrent(this.handlers.picture), maxColumns);
    const video = this.video = new VideoStream({
      picture: ifCurrent(picture => {
        this.failures = 0;
        this.handlers.picture(picture);
      }),
      skipped: ifCurrent(sequence => this.send('skipped', {sequence})),
      failed: ifCurrent(() => this.#videoFailed()),
      maxColumns,
    });
    let opened = false;
    this.checks = 0;
    socket.binaryType = 'arraybuffer';
    socket.onopen = ifCurrent(() => {
      opened = true;
      this.handlers.open();
    });
    const takePicture = (data, byDatagrams) => {
      this.checks = 0;
      this.handlers.received(data.byteLength);
      const [header, file] = parsed(data);
      (header.chunk ? video : decoder).take({...header, byDatagrams}, file);
      return header;
    };
    socket.onmessage = ifCurrent(({data}) => {
      this.checks = 0;
      this.retryMs = FIRST_RETRY_MS;
      if (typeof data !== 'string') {
        // One that is newer than those by datagrams: the server has given these up.
        if (takePicture(data, false).sequence > (this.datagrams?.newest || Infinity)) this.datagrams.close();
        return;
      }
      const message = JSON.parse(data);
      if (message.type !== 'datagrams') {
        this.handlers[message.type](message);
      } else if (globalThis.WebTransport) {
        this.datagrams = new Datagrams(
          message, ifCurrent(({buffer}) => takePicture(buffer, true)));
      }
    });
    socket.onclose = ifCurrent(({code, reason}) => {
      this.#lost(code === FULL ? 'All places are taken: close the page elsewhere.'
        : code === REFUSED ? `The server refused this page: ${reason}.` : '');
      if (!opened) this.#askWhy();
    });
  }

  // A browser that cannot after all gets files.
  #videoFailed() {
    this.failures += 1;
    if (this.failures < MAX_FAILURES) {
      this.send('need_key');
      return;
    }
    this.takesVideo = false;
    this.handlers.withoutVideo();
    this.socket.close();
    this.#lost('');
  }

  // Counted, not timed: a page that was held up has not listened meanwhile.
  #check() {
    const most = this.datagrams?.open ? SILENT_CHECKS_WITH_DATAGRAMS : SILENT_CHECKS;
    if (!this.socket || ++this.checks < most) return;
    this.socket.close();
    this.#lost('');
  }

  #lost(reason) {
    this.datagrams?.close();
    this.socket = this.datagrams = null;
    this.video.close();
    this.handlers.closed(reason);
    setTimeout(() => this.#open(), this.retryMs);
    this.retryMs = Math.min(2 * this.retryMs, LAST_RETRY_MS);
  }

  // Of a WebSocket that is refused the browser does not tell why.
  async #askWhy() {
    const answer = await fetch(location.href, {cache: 'no-store'}).catch(() => null);
    if (answer?.status === FORBIDDEN && this.socket?.readyState !== WebSocket.OPEN) {
      this.handlers.closed(MOVED);
    }
  }
}

// Decodes one picture at a time; of those that come meanwhile only the newest counts.
class PictureDecoder {
  constructor(done, maxColumns) {
    Object.assign(this, {done, maxColumns});
    this.next = null;
    this.busy = false;
  }

  async take(header, file) {
    this.next = [header, file];
    if (this.busy) return;
    this.busy = true;
    while (this.next) {
      const [header, file] = this.next;
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
