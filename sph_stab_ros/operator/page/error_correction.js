// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// Messages out of pieces of which some got lost; error_correction.py says what these are.

const PIECE_BYTES = 1100, HEADER_BYTES = 15;
// More is no picture's.
const MAX_BYTES = 1 << 22;
// Of GF(256): powers of 2, and of what power each number is.
const POWERS = [], LOGARITHMS = [];
for (let n = 0, value = 1; n < 255; n++) {
  POWERS[n] = value;
  LOGARITHMS[value] = n;
  value = value << 1 ^ (value >> 7) * 0x11d;
}
const times = (bytes, power) =>
  bytes.map(one => one && POWERS[(LOGARITHMS[one] + power + 255) % 255]);
const add = (sum, bytes) => {
  for (let n = 0; n < bytes.length; n++) sum[n] ^= bytes[n];
};

export class Messages {
  // take(message): called for each that can be used, in their order. ``usable`` is the number of the
  // last of these, ``newest`` that of the newest that is whole.
  constructor(take) {
    Object.assign(this, {take, usable: 0, newest: 0, parts: new Map()});
  }

  // Takes in what came in a datagram; what is no piece of a message is left out.
  hear(data) {
    if (data.length < HEADER_BYTES) return;
    const view = new DataView(data.buffer, data.byteOffset);
    const [number, after, length] = [0, 4, 8].map(at => view.getUint32(at, true));
    if (number <= this.usable || after >= number || !length || length > MAX_BYTES) return;
    const perGroup = view.getUint8(14);
    if (!perGroup) return;
    const part = this.parts.get(number) ?? new Parts(after, length, perGroup);
    if (part.after !== after || part.length !== length || part.perGroup !== perGroup) return;
    this.parts.set(number, part);
    if (!part.put(view.getUint16(12, true), data.subarray(HEADER_BYTES))) return;
    this.newest = Math.max(this.newest, number);
    this.#use();
  }

  #use() {
    const usable = () => [...this.parts].filter(([, {whole, after}]) =>
      whole && (!after || after === this.usable)).map(([number]) => number);
    for (let next; (next = Math.max(...usable())) > 0;) {
      const {whole} = this.parts.get(next);
      this.usable = next;
      for (const number of this.parts.keys()) {
        if (number <= next) this.parts.delete(number);
      }
      this.take(whole);
    }
  }
}

class Parts {
  constructor(after, length, perGroup) {
    const count = Math.ceil(length / PIECE_BYTES), groups = Math.ceil(count / perGroup);
    Object.assign(this, {
      after, length, perGroup, count, groups, pieces: [], missing: count, whole: null});
  }

  // Tells whether this piece has made it whole.
  put(index, piece) {
    if (this.whole || this.pieces[index] || piece.length !== this.#lengthOf(index)) return false;
    this.pieces[index] = piece;
    if (index < this.count) this.missing -= 1;
    this.#repair(index < this.count ? index % this.groups : index - this.count >> 1);
    if (this.missing) return false;
    this.whole = new Uint8Array(this.length);
    for (let n = 0; n < this.count; n++) {
      this.whole.set(this.pieces[n].subarray(0, this.#lengthOf(n)), n * PIECE_BYTES);
    }
    this.pieces = null;
    return true;
  }

  #lengthOf(index) {
    if (index >= this.count + 2 * this.groups) return -1;
    const start = index < this.count ? index * PIECE_BYTES : 0;
    return Math.min(PIECE_BYTES, this.length - start);
  }

  // Makes one or two lost pieces x and y of a group again, by the sums of the lost ones that are left
  // of P and Q: x + y, and 2^i x + 2^j y.
  #repair(group) {
    const lost = [], [p, q] = this.pieces.slice(this.count + 2 * group, this.count + 2 * group + 2);
    for (let n = group, i = 0; n < this.count; n += this.groups, i++) {
      if (!this.pieces[n]) lost.push({n, i});
    }
    if (!lost.length || lost.length > Boolean(p) + Boolean(q)) return;
    const sum = p?.slice(), weighted = q?.slice();
    for (let n = group, i = 0; n < this.count; n += this.groups, i++) {
      const piece = this.pieces[n];
      if (!piece) continue;
      if (sum) add(sum, piece);
      if (weighted) add(weighted, times(piece, i));
    }
    const [x, y] = lost;
    let first = sum ?? times(weighted, -x.i);
    if (y) {
      // (2^i + 2^j) x, as in characteristic 2 plus is minus.
      add(weighted, times(sum, y.i));
      first = times(weighted, -LOGARITHMS[POWERS[x.i] ^ POWERS[y.i]]);
      add(sum, first);
      this.pieces[y.n] = sum;
    }
    this.pieces[x.n] = first;
    this.missing -= lost.length;
  }
}
