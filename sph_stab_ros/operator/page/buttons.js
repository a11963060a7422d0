// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// The page's buttons and keys.

import {inUse} from './look.js';
import {$} from './panels.js';

const KEYS = {
  r: 'reset', l: 'level', Home: 'centre', b: 'before', f: 'full', '?': 'keys', c: 'take',
  m: 'nextMode', p: 'snapshot', v: 'record', h: 'headset',
};

// actions: by the ids of buttons, and some that have keys only.
export function bindButtons(actions) {
  for (const [id, action] of Object.entries(actions)) $(id)?.addEventListener('click', action);
  addEventListener('keydown', event => {
    if (event.ctrlKey || event.altKey || event.metaKey || event.repeat) return;
    if (document.querySelector('dialog[open]')) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const id = KEYS[key];
    if (!id || $(id)?.hidden || (key === 'Home' && inUse(event.target))) return;
    event.preventDefault();
    actions[id]();
  });
}

// Shows only what this browser can do: some telephones have no full screen, few have a headset.
export async function offerButtons(possible) {
  for (const [id, answer] of Object.entries(possible)) {
    $(id).hidden = !await answer;
  }
}
