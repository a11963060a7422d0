// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// What the operator has to know about the picture: one situation at a time, the worst first.

const SILENCE_MS = 1000, FIRST_PICTURE_MS = 3000;

// Returns {name, icon, text, since, detail, alarm}.
export function situation({failure, connectedAt, reason, pictureAt, stabilized, raw, robot, now}) {
  if (failure) {
    return alarm('unable', 'No picture', failure);
  }
  if (connectedAt === null) {
    return alarm('offline', 'No connection', reason || 'Trying again …');
  }
  if (pictureAt === null && now - connectedAt < FIRST_PICTURE_MS) {
    return {name: 'connecting', icon: 'i-wait', text: 'Connecting'};
  }
  if (pictureAt === null || now - pictureAt > SILENCE_MS) {
    const detail = robot?.camera ? 'The camera sends, but its pictures do not get here.'
      : 'The camera is silent.';
    const since = pictureAt === null ? '' : `for ${Math.floor((now - pictureAt) / 1000)} s`;
    return {...alarm('silent', 'No picture', detail), since};
  }
  if (!stabilized) {
    return alarm('unstabilized', 'Not stabilised',
                 'The stabilizer is silent: the picture turns with the robot.');
  }
  if (robot?.tracking === 'lost') {
    return alarm('lost', 'Tracking lost', 'The picture may turn with the robot.');
  }
  if (raw) {
    return {name: 'raw', icon: 'i-raw', text: 'Raw picture'};
  }
  if (robot?.tracking === 'predicted') {
    return {name: 'doubtful', icon: 'i-warn', text: 'Guessing the rotation'};
  }
  if (robot?.tracking === 'uncertain') {
    return {name: 'doubtful', icon: 'i-warn', text: 'Drifting: reset when it matters'};
  }
  if (robot?.message && !robot.healthy) {
    return {name: 'doubtful', icon: 'i-warn',
            text: robot.message[0].toUpperCase() + robot.message.slice(1)};
  }
  return {name: 'stabilized', icon: 'i-ok', text: 'Stabilised'};
}

function alarm(name, text, detail) {
  return {name, icon: 'i-warn', text, detail, alarm: true};
}
