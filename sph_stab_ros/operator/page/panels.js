// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// What stands around the picture: figures, buttons, modes, the situation and notices.

import {situation} from './situation.js';

export const $ = id => document.getElementById(id);
const NOTICE_MS = 5000;
// Nobody steers well by what is older.
const LATE_MS = 400;
// Until the stabilizer is heard for the first time.
const DEFAULT_MODES = ['lock'];
const MODE_HELP = {
  lock: 'The world stands still',
  follow: 'The view follows slow turns of the robot',
  yaw_follow: 'Level, and the heading follows slow turns of the robot',
};

let noticeTimer;

// Shows what the server tells.
export function showState(state) {
  const {control, robot, rate_hz, latency_ms} = state;
  const figure = (value, unit) => value === null ? '–' : `${Math.round(value)} ${unit}`;
  $('rate').textContent = figure(rate_hz, '/s');
  $('latency').textContent = figure(latency_ms, 'ms');
  $('latency').classList.toggle('late', latency_ms > LATE_MS);
  $('estimates').textContent = figure(robot?.tracking ? robot.rate_hz : null, '/s');
  $('estimator').textContent = robot?.tracking || '–';
  $('drawn-by').textContent = state.slow ? 'processor' : 'graphics card';
  $('control').classList.toggle('hidden', control === 'yours' || control === 'none');
  $('control').firstElementChild.textContent = control === 'taken'
    ? 'Watching: another operator steers.' : 'Nobody steers.';
  for (const [id, possible] of [['reset', robot?.can_reset], ['level', robot?.can_level]]) {
    // Unlike a disabled button one can still come to it by keyboard and hear why it does nothing.
    $(id).setAttribute('aria-disabled', control !== 'yours' || !possible);
  }
  $('record').setAttribute('aria-disabled', control !== 'yours');
  $('record').setAttribute('aria-pressed', Boolean(state.recording));
  $('record').title = state.recording ? `Recording ${state.recording} (V: stop)`
    : 'Record pictures and orientations on the robot (V)';
  // The mode asked for is shown at once, until the answer is there.
  showModes(robot?.modes ?? [], state.wantedMode ?? robot?.mode, control === 'yours');
  showSituation(state);
}

function showModes(modes, mode, steering) {
  const box = $('modes');
  const names = modes.length ? modes : box.dataset.names?.split(',') ?? DEFAULT_MODES;
  if (box.dataset.names !== names.join()) {
    box.dataset.names = names.join();
    box.replaceChildren(box.firstElementChild, ...names.map(name => {
      const label = document.createElement('label');
      const input = Object.assign(document.createElement('input'),
                                  {type: 'radio', name: 'mode', value: name});
      const text = document.createElement('span');
      text.textContent = name[0].toUpperCase() + name.slice(1).replaceAll('_', ' ');
      label.title = `${MODE_HELP[name] ?? text.textContent} (M: next mode)`;
      label.append(input, text);
      return label;
    }));
  }
  for (const input of box.querySelectorAll('input')) {
    if (mode) input.checked = input.value === mode;
    input.disabled = !steering || !modes.length;
  }
}

// Shows for a while what came of a request. The box is always there, if empty: what appears with
// its text is not read out.
export function showNotice(text, ok = true) {
  const box = $('notice');
  box.textContent = text;
  box.classList.toggle('refusal', !ok);
  clearTimeout(noticeTimer);
  noticeTimer = setTimeout(() => { box.textContent = ''; }, NOTICE_MS);
}

// Returns what the pictures come by, and what would be better; secure is that of the browser, which
// takes a page of the same machine for secure. Video takes both, the browser's and the server's.
export function linkText({encrypted, secure, slow, takesVideo, can_video}) {
  const video = takesVideo && can_video;
  const used = `Pictures come as ${video ? 'H.264 video' : 'JPEG'} by ${encrypted ? 'https' : 'http'}`
    + `, and are drawn by ${slow ? 'the processor' : 'the graphics card'}.`;
  if (!encrypted && !secure) {
    return `${used} By https nobody on the way could see them, and many browsers would take video, `
      + 'a tenth of the bits, decode JPEG in half the time, and take gamepads.';
  }
  return video ? used : `${used} ${takesVideo
    ? 'H.264 would be a tenth of the bits: it needs PyAV at the robot.'
    : 'This page takes no H.264, a tenth of the bits.'}`;
}

// Shows whether the picture can be steered by, and since when not.
export function showSituation(state) {
  const now = situation({...state, now: performance.now()});
  document.documentElement.dataset.situation = now.name;
  document.documentElement.classList.toggle('alarmed', Boolean(now.alarm));
  // What the alarm says need not be said twice.
  $('status').setAttribute('aria-live', now.alarm ? 'off' : 'polite');
  setText($('status').querySelector('span'), now.text);
  setIcon($('status'), now.icon);
  $('alarm').classList.toggle('hidden', !now.alarm);
  setText($('alarm').querySelector('strong'), now.alarm ? now.text : '');
  setText($('since'), now.alarm && now.since || '');
  setText($('alarm').querySelector('span'), now.alarm ? now.detail : '');
}

// Returns what is said within a headset, whose user does not see the page, and whether the picture may
// turn with the robot.
export function signOf(state) {
  const now = situation({...state, raw: false, now: performance.now()});
  const control = state.control === 'yours' || state.control === 'none' ? ''
    : `${$('control').firstElementChild.textContent} The trigger takes control.`;
  return {
    text: [now.text, now.since].filter(Boolean).join(' '), alarm: Boolean(now.alarm),
    turning: now.name === 'lost' || now.name === 'unstabilized',
    detail: now.alarm ? now.detail : $('notice').textContent || control,
  };
}

// Only changes are read out.
function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function setIcon(element, icon) {
  element.querySelector('use').setAttribute('href', `#${icon}`);
}
