# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Google's Camera Motion Metadata: packets of one measurement each.

By the specification (developers.google.com/streetview/publish/camm-spec) a packet is a reserved
and a type's number of 16 bits, then floats of 32 bits, little-endian: type 0 the orientation as a
rotation vector from the camera to a world, 2 the angular velocity in rad/s, 3 what the
accelerometer shows in m/s² (as Android has it, 9.8 upwards at rest). The camera's axes are x
right, y down, z forward, which IMUs' should be turned to. The times are the track's.
"""

from array import array
from collections.abc import Iterable
import struct

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.conventions import R_BODY_CAMERA, R_CAMERA_BODY
from sph_stab_ros.recording.telemetry.base import check_count, Series, series, Telemetry

ORIENTATION, RATE, FORCE = 0, 2, 3
# Bytes of each type of packet, with the four before.
SIZES = {0: 16, 1: 12, 2: 16, 3: 16, 4: 16, 5: 28, 6: 60, 7: 16}


def is_sample(data: bytes) -> bool:
    """Tell whether a track's sample is CAMM."""
    if len(data) < 4:
        return False
    reserved, kind = struct.unpack_from('<HH', data)
    return reserved == 0 and SIZES.get(kind) == len(data)


def read(packets: Iterable[tuple[float, float, bytes]]) -> Telemetry:
    """Return the Telemetry of packets with their times in s and durations."""
    times_s = {kind: array('d') for kind in (ORIENTATION, RATE, FORCE)}
    values = {kind: bytearray() for kind in times_s}
    for count, (time_s, _, data) in enumerate(packets):
        check_count(count)
        if is_sample(data) and (kind := data[2]) in times_s:
            times_s[kind].append(time_s)
            values[kind] += data[4:]

    def measured(kind: int) -> Series | None:
        return series(np.array(times_s[kind]), np.frombuffer(values[kind], '<f4').reshape(-1, 3))

    def in_body(found: Series | None) -> Series | None:
        return found and Series(found.stamps_ns, R_BODY_CAMERA.apply(found.vectors))

    orientations = measured(ORIENTATION)
    if orientations is not None:
        R_world_body = Rotation.from_rotvec(orientations.vectors) * R_CAMERA_BODY
        orientations = Series(orientations.stamps_ns, R_world_body.as_rotvec())
    return Telemetry('CAMM', in_body(measured(RATE)), in_body(measured(FORCE)), orientations)
