// Copyright 2026 The sph_stab_ros developers
// SPDX-License-Identifier: Apache-2.0

// Rotations as the package has them: optical axes (x right, y down, z forward), R_a_b maps
// b-coordinates into a, quaternions [x, y, z, w]. Angles in radians: yaw to the left, pitch up,
// roll clockwise as seen.

export function multiply([ax, ay, az, aw], [bx, by, bz, bw]) {
  return [
    aw * bx + ax * bw + ay * bz - az * by,
    aw * by - ax * bz + ay * bw + az * bx,
    aw * bz + ax * by - ay * bx + az * bw,
    aw * bw - ax * bx - ay * by - az * bz,
  ];
}

export function inverse([x, y, z, w]) {
  return [-x, -y, -z, w];
}

// R_virtual_view of a view direction.
export function fromYawPitch(yaw, pitch) {
  return multiply([0, Math.sin(-yaw / 2), 0, Math.cos(-yaw / 2)],
                  [Math.sin(pitch / 2), 0, 0, Math.cos(pitch / 2)]);
}

// The same, leaning to the right by roll.
export function fromAngles(yaw, pitch, roll) {
  return multiply(fromYawPitch(yaw, pitch), [0, 0, Math.sin(roll / 2), Math.cos(roll / 2)]);
}

// Of a rotation about the vertical alone: the same yaw with a level horizon.
export function levelled(quaternion) {
  return fromYawPitch(anglesOf(quaternion).yaw, 0);
}

// The 3×3 matrix by columns, as WebGL takes it.
export function matrix([x, y, z, w]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w),
    2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w),
    2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y),
  ];
}

// Yaw, pitch and roll of a body whose forward axis is z.
export function anglesOf(quaternion) {
  const m = matrix(quaternion);
  return {
    yaw: -Math.atan2(m[6], m[8]),
    pitch: Math.asin(Math.max(-1, Math.min(1, -m[7]))),
    roll: Math.atan2(m[1], m[4]),
  };
}

export const degrees = radians => radians * 180 / Math.PI;
export const radians = degrees => degrees * Math.PI / 180;

// The same angle within −180° and 180°.
export const wrapped = angle => angle - 360 * Math.round(angle / 360);
