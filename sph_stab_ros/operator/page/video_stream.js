// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// The camera's video into pictures, by WebCodecs: each as soon as it comes, and with its own header.

import {imageOf} from './decoder.js';

const CONFIG = {codec: 'avc1.640028', optimizeForLatency: true};

// Whether this browser can; those that can do so in secure contexts only.
export async function canDecodeVideo() {
  if (!globalThis.VideoDecoder) return false;
  const answer = await VideoDecoder.isConfigSupported(CONFIG).catch(() => null);
  return Boolean(answer?.supported);
}

export class VideoStream {
  // handlers: picture({...header, image}), skipped(sequence), failed() where pictures are lost so
  // that a key picture has to come, and maxColumns(), that an image may have.
  constructor(handlers) {
    Object.assign(this, {
      handlers, headers: new Map(), decoder: null, codec: '', frame: null, busy: false, last: 0});
  }

  // Takes the next part of the video; one that comes late, another way than those behind it, is
  // left out.
  take(header, data) {
    if (header.sequence <= this.last) return;
    this.last = header.sequence;
    try {
      if (header.chunk === 'key') this.#configure(header.codec || CONFIG.codec);
      if (!this.decoder) {
        this.handlers.skipped(header.sequence);
        return;
      }
      this.headers.set(header.sequence, header);
      this.decoder.decode(new EncodedVideoChunk(
        {type: header.chunk, timestamp: header.sequence, data}));
    } catch {
      this.#fail();
    }
  }

  close() {
    if (this.decoder?.state !== 'closed') this.decoder?.close();
    this.frame?.close();
    this.decoder = this.frame = null;
    this.codec = '';
    this.headers.clear();
  }

  // A decoder that is there goes on with key pictures, of other sizes too; a camera's own video is
  // of another codec than the server's.
  #configure(codec) {
    if (codec === this.codec) return;
    if (!this.decoder) {
      const decoder = this.decoder = new VideoDecoder({
        output: frame => decoder === this.decoder ? this.#output(frame) : frame.close(),
        error: () => { if (decoder === this.decoder) this.#fail(); },
      });
    }
    this.codec = codec;
    this.decoder.configure({...CONFIG, codec});
  }

  #fail() {
    const last = [...this.headers.keys()].at(-1);
    this.close();
    if (last !== undefined) this.handlers.skipped(last);
    this.handlers.failed();
  }

  // One at a time; of those that come meanwhile only the newest counts.
  async #output(frame) {
    this.frame?.close();
    this.frame = frame;
    if (this.busy) return;
    this.busy = true;
    while (this.frame) {
      const next = this.frame, header = this.headers.get(next.timestamp);
      this.frame = null;
      for (const sequence of this.headers.keys()) {
        if (sequence <= next.timestamp) this.headers.delete(sequence);
      }
      const image = await imageOf(next, this.handlers.maxColumns()).catch(() => null);
      if (header) this.handlers.picture({...header, image});
      else image?.close();
    }
    this.busy = false;
  }
}
