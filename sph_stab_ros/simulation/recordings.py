# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Recordings of simulated flights: pictures, and truth as a motion-capture system gives it.

The truth is the pose of a body of markers that sits on the camera somehow,
``R_mocap_markers = R_mocap_camera R_camera_markers``, at 100 Hz, between the frames.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import Bgr, Image, Stamps, Vector, Vectors
from sph_stab_ros.geometry.conventions import R_CAMERA_BODY
from sph_stab_ros.recording import RecordingError
from sph_stab_ros.recording.bag_writer import BagWriter, FILES
from sph_stab_ros.recording.messages import compressed_image
from sph_stab_ros.recording.partial_output import partial_output
from sph_stab_ros.simulation.flights import Flight

IMAGE_TOPIC = '/theta/image_raw/compressed'
TRUTH_TOPIC = '/vrpn/pose'
CAMERA_FRAME = 'theta_camera'
TRUTH_FRAME = 'mocap'

# Markers never sit straight: an upright body, put on with a few odd degrees and centimetres.
R_CAMERA_MARKERS = R_CAMERA_BODY * Rotation.from_euler('ZYX', (7.0, -4.0, 2.5), degrees=True)
P_CAMERA_MARKERS_M = np.array((0.03, 0.09, -0.05))

_TRUTH_PERIOD_NS = 10_000_000
_TRUTH_PHASE_NS = 3_700_000
_TRUTH_MARGIN_NS = 100_000_000  # truth before the first frame and after the last


def truth(flight: Flight, R_camera_markers: Rotation = R_CAMERA_MARKERS
          ) -> tuple[Stamps, Rotation, Vectors]:
    """Return stamps (N,) int64 in ns, ``R_mocap_markers`` and positions (N, 3) in metres."""
    first_ns = flight.stamps_ns[0]
    stamps_ns = np.arange(first_ns - _TRUTH_MARGIN_NS + _TRUTH_PHASE_NS,
                          flight.stamps_ns[-1] + _TRUTH_MARGIN_NS, _TRUTH_PERIOD_NS)
    t_s = (stamps_ns - first_ns) * 1e-9
    R_mocap_camera = flight.R_mocap_camera(t_s)
    return (stamps_ns, R_mocap_camera * R_camera_markers,
            flight.p_mocap_camera(t_s) + R_mocap_camera.apply(P_CAMERA_MARKERS_M))


def write_recording(path: Path, flight: Flight, images: Iterable[Image], quality: int = 80,
                    force: bool = False, R_camera_markers: Rotation = R_CAMERA_MARKERS) -> None:
    """
    Write a rosbag2 folder (MCAP) of a flight from its pictures, one for each frame.

    Parameters
    ----------
    path : Path
        The folder; it appears when complete.
    flight : Flight
        Where the stamps and the truth come from.
    images : iterable of array
        BGR (width / 2, width, 3), in order; RecordingError if there are too few or too many.
    quality : int
        Of the JPEG compression, 1 to 100.
    force : bool
        Whether to replace the folder; RecordingError if it exists otherwise.
    R_camera_markers : Rotation
        How the markers sit on the camera.

    """
    with partial_output(path, force, FILES) as partial, BagWriter(partial) as bag:
        poses = list(zip(*truth(flight, R_camera_markers)))
        written = 0
        for image in images:
            if written == len(flight.stamps_ns):
                raise RecordingError(f'more pictures than the {written} frames of the flight')
            stamp_ns = int(flight.stamps_ns[written])
            while poses and poses[0][0] <= stamp_ns:
                _write_pose(bag, *poses.pop(0))
            _write_image(bag, stamp_ns, image, quality)
            written += 1
        if written < len(flight.stamps_ns):
            raise RecordingError(
                f'{written} pictures for the {len(flight.stamps_ns)} frames of the flight')
        for pose in poses:
            _write_pose(bag, *pose)


def read_frames(folder: Path, flight: Flight, whole_flight: Flight) -> Iterator[Bgr]:
    """
    Yield the pictures of a flight from a folder of rendered ones, ``000000.png`` and so on.

    The numbers count the frames of ``whole_flight``, of which ``flight`` is a part.
    """
    for number in np.searchsorted(whole_flight.stamps_ns, flight.stamps_ns):
        path = folder / f'{number:06d}.png'
        image = cv2.imread(str(path)) if path.exists() else None
        if image is None:
            raise RecordingError(f'{path} is missing or no picture')
        if image.shape[1] != 2 * image.shape[0]:
            raise RecordingError(f'{path} is {image.shape[1]}×{image.shape[0]}, not 2:1')
        yield image


def _write_image(bag: BagWriter, stamp_ns: int, image: Image, quality: int) -> None:
    bag.write(IMAGE_TOPIC, compressed_image(bag.make, stamp_ns, CAMERA_FRAME, image, quality),
              stamp_ns)


def _write_pose(
        bag: BagWriter, stamp_ns: int, R_mocap_markers: Rotation, position_m: Vector) -> None:
    qx, qy, qz, qw = R_mocap_markers.as_quat()
    x, y, z = position_m
    pose = bag.type('geometry_msgs/msg/Pose')(
        position=bag.type('geometry_msgs/msg/Point')(x=x, y=y, z=z),
        orientation=bag.type('geometry_msgs/msg/Quaternion')(x=qx, y=qy, z=qz, w=qw))
    bag.write(TRUTH_TOPIC, bag.type('geometry_msgs/msg/PoseStamped')(
        header=bag.header(int(stamp_ns), TRUTH_FRAME), pose=pose), int(stamp_ns))
