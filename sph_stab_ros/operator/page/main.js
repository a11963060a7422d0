// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// The page: pictures in, look direction out, everything else around it.

import {Connection} from './connection.js';
import {AttitudeDial, HeadingTape} from './instruments.js';
import {inUse, Look} from './look.js';
import {LinkPanel} from './link_panel.js';
import {$, linkText, showNotice, showSituation, showState} from './panels.js';
import {Renderer} from './renderer.js';
import {anglesOf, degrees, fromYawPitch, inverse, matrix, multiply} from './rotation.js';
import {canDecodeVideo} from './video_stream.js';

const LOOK_PERIOD_MS = 33, INSTRUMENT_PERIOD_MS = 70;
const SITUATION_PERIOD_MS = 200, DESCRIPTION_PERIOD_MS = 1000;
const MAX_PIXEL_RATIO = 2;
// Without a graphics card, fewer pixels sooner rather than all of them later.
const SLOW_SHARE = 0.5;
const NO_CONTROL = {
  none: 'No connection.',
  free: 'Nobody steers: take control first.',
  taken: 'Another operator steers: take control first.',
};
// What the server tells, as long as it tells nothing.
const UNTOLD = {
  control: 'none', robot: null, rate_hz: null, latency_ms: null, wantedMode: null, can_video: true,
};

const place = $('picture');
const state = {
  ...UNTOLD,
  // Times are those of performance.now().
  connectedAt: performance.now(), reason: '', failure: '',
  // The picture on display, when it came, and whether it had an orientation.
  pictureAt: null, stabilized: true, derotated: false, columns: Infinity,
  R_world_camera: [0, 0, 0, 1], R_world_virtual: [0, 0, 0, 1],
  raw: false,
  // Whether the processor draws, and whether the browser decodes video.
  slow: false, takesVideo: true,
  // Whether the operator has chosen where to look.
  moved: false,
  // The angles on the instruments.
  shown: '',
};
let renderer, waiting = null, drawRequested = false, lookTimer, lookedAt = 0;

// Drawing.

function requestDraw() {
  if (drawRequested) return;
  drawRequested = true;
  requestAnimationFrame(() => {
    drawRequested = false;
    try {
      draw();
    } catch (error) {
      Object.assign(state, {failure: error.message, pictureAt: null});
    }
  });
}

function draw() {
  const picture = waiting;
  waiting = null;
  if (picture) {
    const {image: {width, height}} = picture;
    Object.assign(picture, {width, height});
    state.columns = width;
    renderer.load(picture.image);
    // Without an orientation the last one has to do.
    Object.assign(state, picture.orientation);
    state.stabilized = picture.orientation !== null;
    state.derotated = picture.derotated;
  }
  fit();
  const R_virtual_view = fromYawPitch(look.yaw, look.pitch);
  const R_world_view = multiply(state.raw ? state.R_world_camera : state.R_world_virtual,
                                R_virtual_view);
  const R_world_picture = state.derotated ? state.R_world_virtual : state.R_world_camera;
  const shown = renderer.draw(
    matrix(multiply(inverse(R_world_picture), R_world_view)), look.fov);
  if (picture) {
    if (shown) {
      Object.assign(state, {failure: '', pictureAt: performance.now()});
      place.dataset.stampNs = picture.stamp_ns;
      linkPanel.figures.drawn(picture);
    }
    connection.send('drawn', {sequence: picture.sequence});
  }
}

// Less often than the picture: painting them takes longer than that does without a graphics card.
function showInstruments() {
  const heading = -degrees(anglesOf(multiply(
    state.raw ? state.R_world_camera : state.R_world_virtual,
    fromYawPitch(look.yaw, look.pitch))).yaw);
  const {yaw, pitch, roll} = anglesOf(state.R_world_camera);
  const shown = [heading, -degrees(yaw), degrees(roll), degrees(pitch)].map(a => a.toFixed(1));
  if (shown.join() === state.shown) return;
  state.shown = shown.join();
  tape.show(Number(shown[0]), Number(shown[1]));
  dial.show(Number(shown[2]), Number(shown[3]));
}

function takePicture(picture) {
  const {image, sequence} = picture;
  if (image?.width !== 2 * image?.height) {
    state.failure = image ? `The camera's picture, ${image.width}×${image.height}, is no ` +
      'sphere: start the operator with --pictures stabilizer.' : 'A broken picture has come.';
    image?.close();
    connection.send('skipped', {sequence});
    return;
  }
  waiting?.image.close();
  waiting = picture;
  requestDraw();
}

// Draws as many pixels as the window has; where they are slow, no more than the picture has in view.
function fit() {
  const {clientWidth, clientHeight} = place;
  const longer = Math.max(clientWidth, clientHeight);
  let ratio = Math.min(devicePixelRatio, MAX_PIXEL_RATIO);
  if (renderer.slow) {
    ratio = Math.min(SLOW_SHARE * ratio, columnsInView() / longer);
  }
  renderer.resize(Math.round(clientWidth * ratio), Math.round(clientHeight * ratio));
}

// Where they are fewest, in the middle of the view.
function columnsInView() {
  return state.columns * Math.tan(look.fov / 2) / Math.PI;
}

// What is on the screen is gone, and what comes is drawn otherwise.
function takeFallBack(reason) {
  Object.assign(state, {slow: true, pictureAt: null});
  showState(state);
  showNotice(`${reason} The processor draws now.`, false);
  showLink();
  requestDraw();
}

function showLink() {
  const encrypted = location.protocol === 'https:';
  $('link').textContent = linkText({...state, encrypted, secure: isSecureContext});
}

// Looking.

function looked() {
  state.moved = true;
  requestDraw();
  $('fov').textContent = `${Math.round(degrees(look.fov))}°`;
  if (state.control === 'yours' && !lookTimer) {
    lookTimer = setTimeout(sendLook, Math.max(0, lookedAt + LOOK_PERIOD_MS - performance.now()));
  }
}

function sendLook() {
  lookTimer = null;
  lookedAt = performance.now();
  connection.send('look', {direction: fromYawPitch(look.yaw, look.pitch)});
}

// What the server tells.

function takeState(told) {
  const taken = told.control === 'yours' && state.control !== 'yours';
  if (told.control === 'taken' && state.control === 'yours') {
    showNotice('Another operator has taken control.', false);
  }
  const isNews = told.can_video !== state.can_video;
  Object.assign(state, told);
  if (isNews) showLink();
  if (taken && state.moved) sendLook();
  showState(state);
}

function takeNotice({text, ok, done}) {
  state.wantedMode = null;
  if (done === 'ResetHeading') look.centre();
  showNotice(text, ok);
}

// What the operator does.

// Asks the robot for something, or says why it would be in vain; tells whether it has asked.
function ask(command, possible, values) {
  if (state.control === 'yours' && possible) return connection.send(command, values);
  showNotice(state.control !== 'yours' ? NO_CONTROL[state.control]
    : state.robot.tracking ? 'This stabilizer does not offer that.'
      : 'The stabilizer does not answer.', false);
  return false;
}

function setMode(mode) {
  if (ask('set_mode', state.robot?.modes.length, {mode})) state.wantedMode = mode;
  showState(state);
}

function nextMode() {
  const {modes, mode} = state.robot ?? {modes: []};
  setMode(modes[(modes.indexOf(state.wantedMode ?? mode) + 1) % modes.length]);
}

function takeControl() {
  if (!connection.send('take_control')) showNotice(NO_CONTROL.none, false);
  state.moved = true;
  place.focus();
}

function toggleRaw() {
  state.raw = !state.raw;
  $('before').setAttribute('aria-pressed', state.raw);
  showSituation(state);
  requestDraw();
}

function toggleFull() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen?.();
}

const actions = {
  reset: () => ask('reset_heading', state.robot?.can_reset),
  level: () => ask('level', state.robot?.can_level),
  centre: () => look.centre(),
  before: toggleRaw,
  out: () => look.zoom(1 / 1.25),
  in: () => look.zoom(1.25),
  full: toggleFull,
  keys: () => $('help').showModal(),
  take: takeControl,
};
const keyActions = {
  r: 'reset', l: 'level', Home: 'centre', b: 'before', f: 'full', '?': 'keys', c: 'take',
};

// Start.

// The address chooses by ?video=jpeg.
state.takesVideo = new URLSearchParams(location.search).get('video') !== 'jpeg'
  && await canDecodeVideo();
const tape = new HeadingTape($('tape'));
const dial = new AttitudeDial($('attitude'));
const look = new Look(place, looked, id => actions[id]());
const linkPanel = new LinkPanel($('link-panel'), sent_ms => connection?.send('echo', {sent_ms}));
let connection;
try {
  renderer = new Renderer(place, takeFallBack);
  state.slow = renderer.slow;
  showLink();
  connection = new Connection({
    maxColumns: () => renderer.maxColumns,
    picture: takePicture,
    state: takeState,
    notice: takeNotice,
    echo: told => linkPanel.figures.echoed(told),
    received: bytes => linkPanel.figures.received(bytes),
    withoutVideo: () => showLink(Object.assign(state, {takesVideo: false})),
    open: () => {
      Object.assign(state, {connectedAt: performance.now(), reason: ''});
      linkPanel.figures.reset();
    },
    closed: reason => {
      Object.assign(state, UNTOLD, {connectedAt: null, pictureAt: null, reason});
      showState(state);
    },
  }, state.takesVideo);
  setInterval(() => showSituation(state), SITUATION_PERIOD_MS);
} catch (error) {
  state.failure = error.message;
  showSituation(state);
}

for (const [id, action] of Object.entries(actions)) $(id).addEventListener('click', action);
addEventListener('keydown', event => {
  if (event.ctrlKey || event.altKey || event.metaKey || event.repeat) return;
  if (document.querySelector('dialog[open]')) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (key === 'm') nextMode();
  else if (keyActions[key] && !(key === 'Home' && inUse(event.target))) {
    event.preventDefault();
    actions[keyActions[key]]();
  }
});
$('modes').addEventListener('change', ({target}) => {
  setMode(target.value);
  // After a click arrow keys look around again; those who came by keyboard go on choosing.
  if (!target.matches(':focus-visible')) place.focus();
});
// Some telephones have none.
$('full').hidden = !document.fullscreenEnabled;
document.addEventListener('fullscreenchange', () =>
  $('full').setAttribute('aria-pressed', Boolean(document.fullscreenElement)));
setInterval(showInstruments, INSTRUMENT_PERIOD_MS);
setInterval(() => [tape, dial].forEach(one => one.describe()), DESCRIPTION_PERIOD_MS);
new ResizeObserver(requestDraw).observe(place);
