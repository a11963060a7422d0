// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// The newest picture, from its arrival to the news that it is drawn, on the page or in a headset.

export class Pictures {
  // state: the page's, which is told of them. send(command, values): to the server. seen(picture):
  // called for each that is on display.
  constructor(state, send, seen) {
    Object.assign(this, {state, send, seen, waiting: null, loaded: null});
  }

  // Takes a picture over; tells whether there is one to draw.
  take(picture) {
    const {image, sequence} = picture;
    if (image?.width !== 2 * image?.height) {
      const [width, height] = picture.size ?? [image?.width, image?.height];
      this.state.failure = image ? `The camera's picture, ${width}×${height}, is no ` +
        'sphere: start the operator with --pictures stabilizer.' : 'A broken picture has come.';
      image?.close();
      this.send('skipped', {sequence});
      return false;
    }
    this.waiting?.image.close();
    this.waiting = picture;
    return true;
  }

  // Gives the newest to a renderer, with what it is to be turned by; returns it, or null where there is
  // no new one.
  load(renderer) {
    const picture = this.waiting, {state} = this;
    this.waiting = null;
    if (!picture) return null;
    const {image: {width, height}} = picture;
    if (width > renderer.maxColumns) {
      // It was made for another renderer.
      picture.image.close();
      this.send('skipped', {sequence: picture.sequence});
      return null;
    }
    Object.assign(picture, {width, height});
    this.loaded = picture;
    renderer.load(picture.image);
    // Without an orientation the last one has to do.
    Object.assign(state, picture.orientation, {
      columns: width, stabilized: picture.orientation !== null});
    renderer.R_world_picture = picture.derotated ? state.R_world_virtual : state.R_world_camera;
    return picture;
  }

  // Whoever was to draw has failed: the server waits for news of what was loaded.
  fail(reason) {
    if (reason) Object.assign(this.state, {failure: reason, pictureAt: null});
    if (this.loaded) this.send('skipped', {sequence: this.loaded.sequence});
    this.loaded = null;
  }

  // What load() has returned is drawn, or there is nothing to see of it.
  done(picture, shown) {
    this.loaded = null;
    if (shown) {
      Object.assign(this.state, {failure: '', pictureAt: performance.now()});
      this.seen(picture);
    }
    this.send('drawn', {sequence: picture.sequence});
  }
}
