// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// What unfolds below the figures: how good the link is.

import {LinkFigures} from './link_figures.js';

const PERIOD_MS = 500;
const TEXTS = {
  what: what => what,
  mbit_s: rate => `${rate.toFixed(1)} Mbit/s`,
  drawn: rate => `${Math.round(rate)} /s`,
  dropped: rate => `${Math.round(rate)} /s`,
  latency_ms: ms => `${Math.round(ms)} ms`,
  latency_p95_ms: ms => `${Math.round(ms)} ms`,
  round_trip_ms: ms => `${Math.round(ms)} ms`,
};

export class LinkPanel {
  // box: the <details>. send(command, values): asks the server for an answer to ``figures.echoed``,
  // and tells it the figures, for whoever watches over the robot.
  constructor(box, send) {
    this.figures = new LinkFigures();
    setInterval(() => {
      send('echo', {sent_ms: this.figures.now()});
      const {what, ...figures} = this.figures.figures();
      send('link', figures);
      this.#show(box, {what, ...figures});
    }, PERIOD_MS);
  }

  #show(box, figures) {
    for (const [name, text] of Object.entries(TEXTS)) {
      const value = figures[name];
      box.querySelector(`[data-figure=${name}]`).textContent = value === null ? '–' : text(value);
    }
  }
}
