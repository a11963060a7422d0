// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// What people feel of the link: how old pictures are when they are drawn, how many are left out, and
// what they take.

const WINDOW_MS = 2000;
// Of round trips the shortest tells most exactly how the clocks differ.
const ROUND_TRIPS = 30;
// Stamps that are farther off are of another clock, a recording's.
const MAX_AGE_MS = 60e3;

const quantile = (values, share) =>
  [...values].sort((a, b) => a - b)[Math.floor(share * values.length)] ?? null;

export class LinkFigures {
  // now(): the time in ms since 1970.
  constructor(now = () => performance.timeOrigin + performance.now()) {
    this.now = now;
    this.reset();
  }

  reset() {
    Object.assign(this, {messages: [], pictures: [], roundTrips: [], sequence: null});
  }

  // A message of so many bytes has come.
  received(bytes) {
    this.messages.push({at: this.now(), bytes});
  }

  // A picture is drawn.
  drawn({sequence, stamp_ns, chunk, width, height, byDatagrams}) {
    const at = this.now(), dropped = this.sequence === null ? 0 : sequence - this.sequence - 1;
    this.sequence = sequence;
    const way = byDatagrams ? ' by datagrams' : '';
    this.what = `${chunk ? 'H.264' : 'JPEG'}${way}, ${width}×${height}`;
    const stamp = Number(BigInt(stamp_ns) / 1000n) / 1000;
    this.pictures.push({at, dropped, age: at + this.#offset() - stamp});
  }

  // The server's answer to echo({sent_ms}).
  echoed({sent_ms, server_ms}) {
    const at = this.now();
    this.roundTrips.push({ms: at - sent_ms, offset: server_ms - (at + sent_ms) / 2});
    if (this.roundTrips.length > ROUND_TRIPS) this.roundTrips.shift();
  }

  // By how much the server's clock is ahead.
  #offset() {
    return this.roundTrips.reduce(
      (best, one) => one.ms < best.ms ? one : best, {ms: Infinity, offset: NaN}).offset;
  }

  // Returns {what, mbit_s, drawn and dropped per second, latency_ms and that of the slowest
  // twentieth, round_trip_ms}; null where unknown.
  figures() {
    const since = this.now() - WINDOW_MS, seconds = WINDOW_MS / 1000;
    this.messages = this.messages.filter(({at}) => at >= since);
    this.pictures = this.pictures.filter(({at}) => at >= since);
    const sum = (list, key) => list.reduce((total, one) => total + one[key], 0);
    const ages = this.pictures.map(({age}) => age).filter(age => Math.abs(age) < MAX_AGE_MS);
    return {
      what: this.pictures.length ? this.what : null,
      mbit_s: sum(this.messages, 'bytes') * 8e-6 / seconds,
      drawn: this.pictures.length / seconds,
      dropped: sum(this.pictures, 'dropped') / seconds,
      latency_ms: quantile(ages, 0.5),
      latency_p95_ms: quantile(ages, 0.95),
      round_trip_ms: quantile(this.roundTrips.map(({ms}) => ms), 0.5),
    };
  }
}
