// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// The page: pictures in, look direction out, everything else around it.

import {bindButtons, offerButtons} from './buttons.js';
import {Commands} from './commands.js';
import {Connection} from './connection.js';
import {hasHeadset, Headset} from './headset.js';
import {AttitudeDial, HeadingTape} from './instruments.js';
import {Look} from './look.js';
import {LookSender} from './look_sender.js';
import {LinkPanel} from './link_panel.js';
import {$, linkText, showNotice, showSituation, showState, signOf} from './panels.js';
import {hasSensor, PhoneSensor} from './phone_sensor.js';
import {Pictures} from './pictures.js';
import {Renderer} from './renderer.js';
import {anglesOf, degrees, inverse, matrix, multiply} from './rotation.js';
import {saveSnapshot} from './snapshot.js';
import {canDecodeVideo} from './video_stream.js';

const INSTRUMENT_PERIOD_MS = 70, SITUATION_PERIOD_MS = 200, DESCRIPTION_PERIOD_MS = 1000;
const MAX_PIXEL_RATIO = 2;
// Without a graphics card, fewer pixels sooner rather than all of them later.
const SLOW_SHARE = 0.5;
// What the server tells, as long as it tells nothing.
const UNTOLD = {
  control: 'none', robot: null, rate_hz: null, latency_ms: null, wantedMode: null, can_video: true,
  recording: '',
};

const place = $('picture');
const state = {
  ...UNTOLD,
  // Times are those of performance.now().
  connectedAt: performance.now(), reason: '', failure: '',
  // The picture on display, when it came, and whether it had an orientation.
  pictureAt: null, stabilized: true, columns: Infinity,
  R_world_camera: [0, 0, 0, 1], R_world_virtual: [0, 0, 0, 1],
  raw: false,
  // Whether the processor draws, and whether the browser decodes video.
  slow: false, takesVideo: true,
  // Whether the operator has chosen where to look.
  moved: false,
  // The angles on the instruments.
  shown: '',
};
let renderer, connection, drawRequested = false;

// Drawing.

function requestDraw() {
  if (drawRequested || headset.active) return;
  drawRequested = true;
  requestAnimationFrame(() => {
    drawRequested = false;
    if (headset.active) return;
    try {
      draw();
    } catch (error) {
      pictures.fail(error.message);
    }
  });
}

function draw() {
  const picture = pictures.load(renderer);
  fit();
  const R_world_view = viewed();
  const shown = renderer.draw(
    matrix(multiply(inverse(renderer.R_world_picture ?? R_world_view), R_world_view)), look.fov);
  if (picture) pictures.done(picture, shown);
  return shown;
}

// R_world_view of the page.
function viewed() {
  return multiply(state.raw ? state.R_world_camera : state.R_world_virtual, look.direction);
}

// Less often than the picture: painting them takes longer than that does without a graphics card.
function showInstruments() {
  const heading = -degrees(anglesOf(viewed()).yaw);
  const {yaw, pitch, roll} = anglesOf(state.R_world_camera);
  const shown = [heading, -degrees(yaw), degrees(roll), degrees(pitch)].map(a => a.toFixed(1));
  if (shown.join() === state.shown) return;
  state.shown = shown.join();
  tape.show(Number(shown[0]), Number(shown[1]));
  dial.show(Number(shown[2]), Number(shown[3]));
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
  if (headset.active) return;
  state.moved = true;
  requestDraw();
  $('fov').textContent = `${Math.round(degrees(look.fov))}°`;
  steer(look.direction);
}

function steer(R_virtual_view) {
  if (state.control === 'yours') lookSender.take(R_virtual_view);
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
  if (taken && state.moved) steer(look.direction);
  showState(state);
}

function takeNotice({text, ok, done}) {
  state.wantedMode = null;
  if (done === 'ResetHeading') look.centre();
  showNotice(text, ok);
}

// What the operator does.

function takeControl() {
  commands.take();
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

function snapshot() {
  if (headset.active || !draw()) showNotice('There is no picture on this page to save.', false);
  else showNotice(`Saved: ${saveSnapshot(renderer.canvas, place.dataset.stampNs)}`);
}

async function toggleHeadset() {
  if (headset.active) headset.leave();
  else await headset.enter(look.yaw).catch(error => showNotice(error.message, false));
  showHeadset();
}

function leaveHeadset({yaw, pitch}, reason) {
  if (reason) showNotice(`The headset has stopped: ${reason}`, false);
  look.turnTo(yaw, pitch);
  pictures.fail('');
  showHeadset();
}

// Whoever draws now has no picture yet.
function showHeadset() {
  $('headset').setAttribute('aria-pressed', headset.active);
  if (headset.active) document.documentElement.classList.add('in-headset');
  if (state.connectedAt !== null) {
    Object.assign(state, {connectedAt: performance.now(), pictureAt: null});
  }
}

function toggleSensor() {
  if (sensor.active) sensor.stop(); else sensor.start();
  showSensor();
}

function showSensor() {
  $('sensor').setAttribute('aria-pressed', sensor.active);
  if (!sensor.active) look.turnTo(look.yaw, look.pitch);
}

const actions = {
  reset: () => commands.reset(),
  level: () => commands.level(),
  centre: () => look.centre(),
  before: toggleRaw,
  out: () => look.zoom(1 / 1.25),
  in: () => look.zoom(1.25),
  snapshot,
  record: () => commands.record(),
  sensor: toggleSensor,
  headset: toggleHeadset,
  full: toggleFull,
  keys: () => $('help').showModal(),
  take: takeControl,
  nextMode: () => commands.nextMode(),
};

// Start.

// The address chooses by ?video=jpeg.
state.takesVideo = new URLSearchParams(location.search).get('video') !== 'jpeg'
  && await canDecodeVideo();
const send = (command, values) => connection?.send(command, values);
const tape = new HeadingTape($('tape'));
const dial = new AttitudeDial($('attitude'));
const linkPanel = new LinkPanel($('link-panel'), send);
const commands = new Commands(state, send);
const lookSender = new LookSender(direction => send('look', {direction}));
const pictures = new Pictures(state, send, picture => {
  place.dataset.stampNs = picture.stamp_ns;
  document.documentElement.classList.toggle('in-headset', headset.active);
  linkPanel.figures.drawn(picture);
});
const headset = new Headset({
  load: renderer => pictures.load(renderer),
  drawn: picture => pictures.done(picture, true),
  R_world_virtual: () => state.R_world_virtual,
  looked: steer,
  sign: () => signOf(state),
  take: () => { if (state.control !== 'yours') commands.take(); },
  level: actions.level,
  ended: leaveHeadset,
});
const look = new Look(place, looked, id => actions[id]());
const sensor = new PhoneSensor(
  (left, pitch, roll) => look.turnTo(look.yaw + left, pitch, roll),
  reason => {
    showNotice(reason, false);
    showSensor();
  });
try {
  renderer = new Renderer(place, takeFallBack);
  state.slow = renderer.slow;
  showLink();
  connection = new Connection({
    maxColumns: () => Math.min(renderer.maxColumns, headset.maxColumns),
    picture: picture => { if (pictures.take(picture)) requestDraw(); },
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

bindButtons(actions);
offerButtons({full: document.fullscreenEnabled, headset: hasHeadset(), sensor: hasSensor()});
$('modes').addEventListener('change', ({target}) => {
  commands.setMode(target.value);
  // After a click arrow keys look around again; those who came by keyboard go on choosing.
  if (!target.matches(':focus-visible')) place.focus();
});
document.addEventListener('fullscreenchange', () =>
  $('full').setAttribute('aria-pressed', Boolean(document.fullscreenElement)));
setInterval(showInstruments, INSTRUMENT_PERIOD_MS);
setInterval(() => [tape, dial].forEach(one => one.describe()), DESCRIPTION_PERIOD_MS);
new ResizeObserver(requestDraw).observe(place);
