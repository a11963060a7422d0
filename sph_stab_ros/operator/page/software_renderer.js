// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// Draws what SphereRenderer draws, without WebGL: where there is no graphics card that takes 14 ms
// of two cores, this 6 ms of one (768×432 pixels). What a pixel shows is asked of the sphere at
// the corners of tiles, and interpolated within. Nothing is allocated on the way, which would
// double the time.

import {planar} from './decoder.js';

const TILE = 8;
// What spans more of longitude is near a pole, where it does not go evenly.
const UNEVEN_RAD = 0.15;
// Places are whole numbers of 1/65536 px, in 32 bits.
const SHIFT = 16, ONE = 1 << SHIFT;
const MAX_COLUMNS = 16384;
// JFIF's colours in the same unit.
const R_CR = 91881, G_CB = -22554, G_CR = -46802, B_CB = 116130;

export class SoftwareRenderer {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext('2d', {alpha: false, willReadFrequently: true});
    if (!this.context) throw new Error('This browser has no canvas to draw on.');
    this.slow = true;
    this.maxColumns = MAX_COLUMNS;
    this.image = null;
  }

  // Takes over an image: see ``decode``.
  load(image) {
    this.image?.close();
    this.image = planar(image);
    const {width} = this.image;
    if (this.columns?.length !== 3 * width) {
      // Of places beyond the seam, on either side.
      this.columns = Int16Array.from({length: 3 * width}, (_, n) => n % width);
    }
  }

  // Draws what lies along R_camera_view (9, by columns); fov in radians is that of the longer side.
  // Tells whether there is something to see.
  draw(R_camera_view, fov) {
    const {canvas: {width, height}, image} = this;
    if (!image || !width || !height) return false;
    this.#fit(width, height);
    const place = placer(R_camera_view, fov, width, height, image);
    const target = {width, pixels: new Uint32Array(this.target.data.buffer)};
    const tile = {u: new Float64Array(4), v: new Float64Array(4)};
    const uneven = UNEVEN_RAD / (2 * Math.PI) * image.width;

    const {across, u, v} = this.corners;
    for (let n = 0; n < u.length; n++) {
      place(n % across * TILE, Math.floor(n / across) * TILE, this.corners, n);
    }
    for (let top = 0, n = 0; top < height; top += TILE, n++) {
      for (let left = 0; left < width; left += TILE, n++) {
        let span = 0;
        for (let k = 0; k < 4; k++) {
          const corner = n + (k & 1) + (k >> 1) * across;
          const beyond = u[corner] - u[n];
          const du = beyond - image.width * Math.round(beyond / image.width);  // not over the seam
          span = Math.max(span, Math.abs(du));
          tile.u[k] = u[n] + du;
          tile.v[k] = v[corner];
        }
        const right = Math.min(left + TILE, width), bottom = Math.min(top + TILE, height);
        if (span < uneven) {
          fill(target, this, tile, left, top, right, bottom);
          continue;
        }
        for (let y = top; y < bottom; y++) {
          for (let x = left; x < right; x++) {
            place(x, y, tile, 0);
            tile.u.fill(tile.u[0]);
            tile.v.fill(tile.v[0]);
            fill(target, this, tile, x, y, x + 1, y + 1);
          }
        }
      }
    }
    this.context.putImageData(this.target, 0, 0);
    return true;
  }

  #fit(width, height) {
    if (this.target?.width === width && this.target.height === height) return;
    this.target = this.context.createImageData(width, height);
    const across = Math.ceil(width / TILE) + 1, count = across * (Math.ceil(height / TILE) + 1);
    this.corners = {across, u: new Float64Array(count), v: new Float64Array(count)};
  }
}

// Returns what writes the column u and the row v of the image that a pixel of the view shows.
function placer(R_camera_view, fov, width, height, image) {
  const [xx, xy, xz, yx, yy, yz, zx, zy, zz] = R_camera_view;
  const perPixel = 2 * Math.tan(fov / 2) / Math.max(width, height);
  const pxPerRad = image.width / (2 * Math.PI);
  const last = image.height - 1 - 1 / ONE;
  return (column, row, {u, v}, n) => {
    const a = (column + 0.5 - width / 2) * perPixel, b = (row + 0.5 - height / 2) * perPixel;
    const x = xx * a + yx * b + zx, y = xy * a + yy * b + zy, z = xz * a + yz * b + zz;
    u[n] = (image.width - 1) / 2 + Math.atan2(x, z) * pxPerRad;
    v[n] = Math.max(0, Math.min(last, (image.height - 1) / 2
      + Math.atan2(y, Math.sqrt(x * x + z * z)) * pxPerRad));
  };
}

// Fills pixels of the target from the places of their tile's corners: luma with bilinear weights,
// chroma from the nearest sample.
function fill({width, pixels}, {image, columns}, tile, left, top, right, bottom) {
  const [luma, cb, cr] = image.planes;
  const Y = luma.data, B = cb.data, R = cr.data, lumaStride = luma.stride, chromaStride = cb.stride;
  const halfWide = cb.width < luma.width ? 1 : 0, halfHigh = cb.height < luma.height ? 1 : 0;
  const imageWidth = image.width;
  const {0: u00, 1: u01, 2: u10, 3: u11} = tile.u, {0: v00, 1: v01, 2: v10, 3: v11} = tile.v;
  for (let j = 0; top + j < bottom; j++) {
    const part = j / TILE;
    const u0 = u00 + part * (u10 - u00), v0 = v00 + part * (v10 - v00);
    const du = (u01 + part * (u11 - u01) - u0) * (ONE / TILE) | 0;
    const dv = (v01 + part * (v11 - v01) - v0) * (ONE / TILE) | 0;
    let u = u0 * ONE | 0, v = v0 * ONE | 0;
    const row = (top + j) * width;
    for (let at = row + left; at < row + right; at++, u += du, v += dv) {
      const n = (u >> SHIFT) + imageWidth, column = columns[n], next = columns[n + 1];
      const line = v >> SHIFT, upper = line * lumaStride, lower = upper + lumaStride;
      const across = (u >> 8) & 255, down = (v >> 8) & 255;
      const y0 = Y[upper + column], y1 = Y[lower + column];
      const yUpper = (y0 << 8) + (Y[upper + next] - y0) * across;
      const yLower = (y1 << 8) + (Y[lower + next] - y1) * across;
      const y = (yUpper << 8) + (yLower - yUpper) * down;
      const c = (line + (down >> 7) >> halfHigh) * chromaStride
        + ((across >> 7 ? next : column) >> halfWide);
      const b = B[c] - 128, r = R[c] - 128;
      const red = Math.max(0, Math.min(255, y + R_CR * r >> SHIFT));
      const green = Math.max(0, Math.min(255, y + G_CB * b + G_CR * r >> SHIFT));
      const blue = Math.max(0, Math.min(255, y + B_CB * b >> SHIFT));
      pixels[at] = 0xff000000 | blue << 16 | green << 8 | red;
    }
  }
}
