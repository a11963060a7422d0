# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Rotation of a spherical camera from its video, and the picture with it taken out.

The conventions, stated once; every module relies on them.

**Image.** Equirectangular, width ``W``, height ``H = W / 2``; pixel centres are integers::

    lon = (u + 0.5) / W * 2π − π        lat = π/2 − (v + 0.5) / H * π

**Camera frame** (REP 103, optical): x right, y down, z forward = image centre. A *bearing* is
the unit vector ``x = (cos lat · sin lon, −sin lat, cos lat · cos lon)``.

**Rotations.** ``R_a_b`` maps b-coordinates into a, ``x_a = R_a_b x_b``, and adjacent names
cancel: ``R_a_c = R_a_b * R_b_c``. They are ``scipy.spatial.transform.Rotation`` at every
border; raw 3×3 matrices live only inside kernels.

**World** is the stabilised frame: the camera's orientation at the first frame or at the last
reset, or, with a level horizon, y down along gravity and the camera's heading then along z. The
published orientation is ``R_world_camera``.

**Virtual camera.** The pictures are those of a camera of orientation ``R_world_virtual``: the
world's, or smoothed from the camera's.

**Direction of time.** A point seen at ``x`` in the previous frame is seen at ``x'`` in the
current one; an estimator returns ``R_current_previous`` with ``x' ≈ R_current_previous x``
for points at infinity, and the orientation accumulates as::

    R_world_current = R_world_previous * R_current_previous⁻¹

**Epipole.** ``t_current`` is the unit ``t`` of ``X' = R X + t``: it lies in the current frame,
opposite to the camera's motion, and the flow points towards it.

**Euler angles** of the paper: ``R = R_x(α) R_y(β) R_z(γ)``, SciPy's intrinsic ``'XYZ'``.
Reports speak of roll, pitch and yaw of the body (REP 103: x forward, y left, z up).

**View.** ``R_virtual_view`` from yaw (positive left), pitch (positive up) and roll (positive
clockwise as seen); fields of view are horizontal.

**Units.** Radians, seconds, integer nanoseconds; ``_rad``, ``_deg``, ``_px``, ``_ns`` in names
where it could be doubted. Degrees appear in reports and in parameters named ``…_deg``.

**Failure is a value.** An estimator that cannot tell returns ``None`` or a status, never a
guessed identity.

The method follows S. Pathak, A. Moro, H. Fujii, A. Yamashita and H. Asama, *Spherical video
stabilization by estimating rotation from dense optical flow fields*, J. Robotics and
Mechatronics 29(3), 2017; equation numbers in the code are the paper's.

**As a library.** The names in ``__all__`` are the public API; ``examples/`` shows their use.
Everything else may change. A name is imported when it is first used, so that importing the
package itself takes no time and needs no OpenCV.
"""

from importlib import import_module
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from sph_stab_ros.config import (
        ConfigError, CropConfig, CubemapConfig, FisheyeConfig, ImuConfig, LensConfig,
        SmoothingConfig, StabilizerConfig, TrackerConfig, ViewConfig)
    from sph_stab_ros.geometry.equirect import bearings_from_pixels, pixels_from_bearings
    from sph_stab_ros.geometry.masks import load_mask, MaskError
    from sph_stab_ros.geometry.projection_factory import ProjectionError
    from sph_stab_ros.geometry.trajectory import read_tum, Trajectory, tum_line
    from sph_stab_ros.geometry.warp import (
        equirect_warp, perspective_view, perspective_warp, rotate_equirect, view_rotation)
    from sph_stab_ros.images.frame import Frame
    from sph_stab_ros.recording import open_recording, Recording, RecordingError
    from sph_stab_ros.stabilization.imu import ImuSample
    from sph_stab_ros.stabilization.pipeline import Stabilizer
    from sph_stab_ros.stabilization.recording_loop import stabilize_recording, Summary
    from sph_stab_ros.stabilization.stabilized_frame import StabilizationEvent, StabilizedFrame
    from sph_stab_ros.tracking import make_tracker, TrackedOrientation, Tracker, TrackingStatus
    from sph_stab_ros.tracking.frame_to_frame.estimators import BearingPairs, RotationEstimate
    from sph_stab_ros.tracking.frame_to_frame.methods import ImagePair
    from sph_stab_ros.tracking.frame_to_frame.tracker import FrameToFrameTracker

__version__ = '0.1.0'

__all__ = [
    'BearingPairs', 'ConfigError', 'CropConfig', 'CubemapConfig', 'FisheyeConfig', 'Frame',
    'FrameToFrameTracker', 'ImagePair', 'ImuConfig', 'ImuSample', 'LensConfig', 'MaskError',
    'ProjectionError', 'Recording', 'RecordingError', 'RotationEstimate', 'SmoothingConfig',
    'StabilizationEvent', 'StabilizedFrame', 'Stabilizer', 'StabilizerConfig', 'Summary',
    'TrackedOrientation', 'Tracker', 'TrackerConfig', 'TrackingStatus', 'Trajectory', 'ViewConfig',
    'bearings_from_pixels', 'equirect_warp', 'load_mask', 'make_tracker', 'open_recording',
    'perspective_view', 'perspective_warp', 'pixels_from_bearings', 'read_tum', 'rotate_equirect',
    'stabilize_recording', 'tum_line', 'view_rotation']

# Where each name is defined. Modules are named by strings, which no import contract counts.
_NAMES_BY_MODULE = {
    'config': (
        'ConfigError', 'CropConfig', 'CubemapConfig', 'FisheyeConfig', 'ImuConfig', 'LensConfig',
        'SmoothingConfig', 'StabilizerConfig', 'TrackerConfig', 'ViewConfig'),
    'geometry.equirect': ('bearings_from_pixels', 'pixels_from_bearings'),
    'geometry.masks': ('MaskError', 'load_mask'),
    'geometry.projection_factory': ('ProjectionError',),
    'geometry.trajectory': ('Trajectory', 'read_tum', 'tum_line'),
    'geometry.warp': (
        'equirect_warp', 'perspective_view', 'perspective_warp', 'rotate_equirect',
        'view_rotation'),
    'images.frame': ('Frame',),
    'recording': ('Recording', 'RecordingError', 'open_recording'),
    'stabilization.imu': ('ImuSample',),
    'stabilization.pipeline': ('Stabilizer',),
    'stabilization.recording_loop': ('Summary', 'stabilize_recording'),
    'stabilization.stabilized_frame': ('StabilizationEvent', 'StabilizedFrame'),
    'tracking': ('TrackedOrientation', 'Tracker', 'TrackingStatus', 'make_tracker'),
    'tracking.frame_to_frame.estimators': ('BearingPairs', 'RotationEstimate'),
    'tracking.frame_to_frame.methods': ('ImagePair',),
    'tracking.frame_to_frame.tracker': ('FrameToFrameTracker',),
}
_MODULE_OF = {name: module for module, names in _NAMES_BY_MODULE.items() for name in names}


def _public(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _MODULE_OF:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = getattr(import_module(f'{__name__}.{_MODULE_OF[name]}'), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


if not TYPE_CHECKING:
    # Hidden from type checkers, which would take every misspelt name for one of these.
    __getattr__ = _public
