# Copyright 2026 The sph_stab_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The whole algorithm: track the camera's orientation, take it out of the picture."""

from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import MIN_WIDTH, StabilizerConfig
from sph_stab_ros.equirect import is_equirect
from sph_stab_ros.frame import Frame
from sph_stab_ros.trackers import make_tracker, TrackingStatus, working_width
from sph_stab_ros.trajectory import NS_PER_S
from sph_stab_ros.warp import perspective_view, rotate_equirect, view_rotation

# Without a frame for so long, motion in between is guesswork.
LONG_GAP_S = 1.0


class FrameError(ValueError):
    """A frame that cannot be used, with the reason in one line for the user."""


class Notice(Enum):
    """Something about a frame that its user should hear of; the frame was used all the same."""

    RESIZED = 'the image size changed; tracking starts anew from the last orientation'
    STAMP_NOT_INCREASING = 'the stamp is not later than the one before'
    GAP = f'no frame for more than {LONG_GAP_S:g} s'


@dataclass(frozen=True)
class StabilizedFrame:
    """A frame with its orientation; pictures are computed when they are asked for."""

    frame: Frame
    R_world_camera: Rotation
    status: TrackingStatus
    notices: tuple[Notice, ...] = ()

    @property
    def stamp_ns(self):
        """Stamp of the input frame in nanoseconds."""
        return self.frame.stamp_ns

    def sphere(self):
        """Return the derotated equirectangular image, of the input's size."""
        return rotate_equirect(self.frame.image, self.R_world_camera.inv())

    def view(self, R_world_view, hfov_rad, size_wh):
        """Return the virtual rotation-less camera's perspective image (h, w[, C])."""
        R_camera_view = self.R_world_camera.inv() * R_world_view
        return perspective_view(self.frame.image, R_camera_view, hfov_rad, size_wh)


class Stabilizer:
    """Takes the camera's rotation out of a stream of frames."""

    def __init__(self, config=StabilizerConfig()):
        self.config = config
        self.reset()

    def reset(self):
        """Make the next frame's orientation the world's."""
        self._tracker = None
        self._last = None
        self._R_world_start = Rotation.identity()
        self._R_world_camera = Rotation.identity()

    def reconfigure(self, config):
        """
        Take on another config.

        A tracker that changes by it starts anew at the last frame, in the orientation reached.
        """
        if config.tracker != self.config.tracker:
            self._tracker = None
        self.config = config

    def process(self, frame):
        """Return the StabilizedFrame of the next Frame, or raise FrameError."""
        check_size(frame.image)
        notices = tuple(self._notices(frame))
        if self._tracker is None or Notice.RESIZED in notices:
            self._start(frame)
        tracked = self._track(frame)
        self._R_world_camera = self._R_world_start * tracked.R_world_camera
        self._last = frame
        return StabilizedFrame(frame, self._R_world_camera, tracked.status, notices)

    def _notices(self, frame):
        if self._last is None:
            return
        if frame.image.shape[:2] != self._last.image.shape[:2]:
            yield Notice.RESIZED
        elapsed_s = (frame.stamp_ns - self._last.stamp_ns) / NS_PER_S
        if elapsed_s <= 0:
            yield Notice.STAMP_NOT_INCREASING
        elif elapsed_s > LONG_GAP_S:
            yield Notice.GAP

    def _start(self, frame):
        """Start a tracker for frames of this size, in the orientation and place reached so far."""
        self._working_width = min(working_width(self.config.tracker), frame.image.shape[1])
        self._tracker = make_tracker(self.config.tracker, self._working_width)
        self._R_world_start = self._R_world_camera
        if self._last is not None and self._last.image.shape[:2] == frame.image.shape[:2]:
            self._track(self._last)

    def _track(self, frame):
        return self._tracker.track(to_grey(frame.image, self._working_width), frame.stamp_ns)


def check_size(image):
    """Raise FrameError where an image (H, W[, C]) is not a sphere of a useful size."""
    height, width = image.shape[:2]
    if not is_equirect(image.shape):
        raise FrameError(f'the image is {width}x{height}; an equirectangular image is 2:1')
    if width < MIN_WIDTH:
        raise FrameError(f'the image is {width} px wide; at least {MIN_WIDTH} are needed')


def to_grey(image, width):
    """Return the image (H, W[, 3]), BGR or grey, as a grey one (width / 2, width)."""
    if image.shape[1] != width:
        image = cv2.resize(image, (width, width // 2), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image


def view_direction(view):
    """Return R_world_view of a ViewConfig."""
    return view_rotation(*np.deg2rad((view.yaw_deg, view.pitch_deg, view.roll_deg)))
