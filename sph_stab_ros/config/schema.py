# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Every option of the algorithm and of the ROS node around it."""

from dataclasses import dataclass, fields
import re

from sph_stab_ros.config.options import Checked, ConfigError, Option, option, options
from sph_stab_ros.config.projection import (
    CropConfig, CubemapConfig, EQUIRECT, FisheyeConfig, MIN_WIDTH, PROJECTIONS)

# The names that options choose from stand here, on the ground; the algorithms read them from here.
ANCHORED = 'anchored'
# The paper's three ways from a pair of pictures to a rotation.
METHODS = ('pts', 'moment', 'pts_epipolar')
FLOWS = ('farneback', 'dis')
FIRST_FRAME = 'first_frame'
IMU = 'imu'
LEVELS = (FIRST_FRAME, IMU)
ROWS = 'rows'
COLUMNS = 'columns'
READ_IN = (ROWS, COLUMNS)
LOCK = 'lock'
FOLLOW = 'follow'
YAW_FOLLOW = 'yaw_follow'
MODES = (LOCK, FOLLOW, YAW_FOLLOW)
# As image_transport and its plugins name them.
IMAGE_TRANSPORTS = ('raw', 'compressed', 'ffmpeg', 'foxglove')
# The only view, unless others are named.
VIEW = 'view'
VIEW_NAME = '[A-Za-z]([A-Za-z0-9]|_(?!_))*'
# Roots of topics and of rclpy's own parameters.
RESERVED = ('image', 'imu', 'orientation', 'orientation_covariance', 'qos_overrides', 'stabilized',
            'virtual_orientation')
AUTO = 'auto'
MONO = 'mono'
TOP_BOTTOM = 'top_bottom'
LEFT_RIGHT = 'left_right'
VR180 = 'vr180'
HALF_SPHERE = 'half_sphere'
PICTURE_LAYOUTS = (AUTO, MONO, TOP_BOTTOM, LEFT_RIGHT, VR180, HALF_SPHERE)
NOT_JOINED = 'none'
JOINS = (NOT_JOINED, LEFT_RIGHT, TOP_BOTTOM)


@dataclass(frozen=True)
class TrackerConfig(Checked):
    """How the rotation is estimated."""

    estimator: str = option(
        ANCHORED, 'Estimator of the rotation: anchored to keyframes, or one of the paper, chained '
        'from frame to frame', choices=(ANCHORED, *METHODS))
    flow: str = option('farneback', "Dense optical flow of the paper's estimators",
                       choices=FLOWS)
    flow_updates: int = option(
        0, 'How often the flow is computed again on the derotated image', minimum=0, maximum=5)
    epipolar_bound_deg: float = option(
        30., 'Angle in degrees at which flow off its epipolar circle counts a quarter in '
        "pts_epipolar; 180 for the paper's plain sum of squares",
        minimum=1., maximum=180.)
    working_width: int = option(
        0, 'Width in pixels that images are reduced to for the estimator, at least 128; 0 leaves '
        'it to the estimator: 640 for anchored, 480 for the others', minimum=0, maximum=3840)
    mask: str = option(
        '', "Pixels not to use: path of a 2:1 image (black) or 'lat:FROM,TO' in degrees")
    rolling_shutter_s: float = option(
        0., 'For how long in seconds a picture is read, from its first row or column to the last '
        '(rolling shutter), negative where the last one is the first; stamps are of the middle',
        minimum=-0.1, maximum=0.1)
    rolling_shutter_by: str = option(
        ROWS, 'What of a picture is read one after the other: its rows from above, or its columns '
        'from the left where the sensor lies on its side', choices=READ_IN)
    max_prediction_s: float = option(
        0.5, 'For how long in seconds the last angular velocity is trusted without measurement',
        minimum=0., maximum=10.)

    def __post_init__(self) -> None:
        """Check each option's value."""
        super().__post_init__()
        if 0 < self.working_width < MIN_WIDTH:
            raise ConfigError(f'working_width is 0 or at least {MIN_WIDTH}')


@dataclass(frozen=True)
class ViewConfig(Checked):
    """The virtual camera: where it looks in the stabilised frame, and its picture."""

    yaw_deg: float = option(
        0., 'Direction in degrees, positive to the left', minimum=-360., maximum=360.)
    pitch_deg: float = option(
        0., 'Direction in degrees, positive up', minimum=-90., maximum=90.)
    roll_deg: float = option(
        0., 'Turn about the direction in degrees, positive clockwise', minimum=-180., maximum=180.)
    hfov_deg: float = option(
        90., 'Horizontal field of view in degrees', minimum=10., maximum=150.)
    width: int = option(640, 'Width in pixels', minimum=16, maximum=7680)
    height: int = option(480, 'Height in pixels', minimum=16, maximum=4320)
    frame_id: str = option(
        'view_optical', 'frame_id of the virtual camera; those of other views begin with their '
        'names', live=False)


@dataclass(frozen=True)
class SmoothingConfig(Checked):
    """What of the camera's turning stays in the pictures."""

    mode: str = option(
        LOCK, 'What the pictures keep of the turning: nothing (lock), slow turns (follow), or '
        'slow turns of heading with a level horizon (yaw_follow)', choices=MODES)
    time_constant_s: float = option(
        2., 'How far in seconds the pictures of the other modes stay behind a steady turn',
        minimum=0.05, maximum=60.)


@dataclass(frozen=True)
class ImuConfig(Checked):
    """How the IMU sits: as a URDF says it, about fixed x forward, y left, z up of the camera."""

    roll_deg: float = option(
        0., "The IMU's roll in degrees, from axes x through the image centre, y left, z up",
        minimum=-360., maximum=360.)
    pitch_deg: float = option(
        0., "The IMU's pitch in degrees, positive down, after roll",
        minimum=-360., maximum=360.)
    yaw_deg: float = option(
        0., "The IMU's yaw in degrees, positive to the left, after roll and pitch",
        minimum=-360., maximum=360.)


@dataclass(frozen=True)
class StabilizerConfig(Checked):
    """What the stabiliser needs to know."""

    tracker: TrackerConfig = TrackerConfig()
    view: ViewConfig = ViewConfig()
    smoothing: SmoothingConfig = SmoothingConfig()
    imu: ImuConfig = ImuConfig()
    level: str = option(
        FIRST_FRAME, "What is level: the first image's orientation, or what the IMU on the topic "
        'imu says, whose gyro then predicts turns as well', choices=LEVELS)
    projection: str = option(
        EQUIRECT, 'What the images are: equirectangular; the two circles of two fisheye lenses as '
        'calibrated in fisheye.*, or one (fisheye); a whole sphere of another aspect than 2:1; '
        'the part of a sphere in crop.*; six faces of a cube 3x2, 6x1, 1x6 or 4x3 (cubemap), or '
        'as YouTube or the two tracks of a GoPro Max have them', choices=PROJECTIONS)
    layout: str = option(
        AUTO, "Where an equirectangular image holds the sphere: as a video's metadata say, else "
        'it is the sphere (auto); one sphere whatever they say (mono); two of them for two eyes, '
        'of which the left one is used (top_bottom, left_right); two front halves (vr180); one '
        '(half_sphere)', choices=PICTURE_LAYOUTS)
    join: str = option(
        NOT_JOINED, 'Put the pictures of two lenses that come one by one, as two tracks of a '
        'video or on the topics image and image_rear, side by side (left_right) or one above the '
        'other (top_bottom), for projection to read', choices=JOINS, live=False)
    fisheye: FisheyeConfig = FisheyeConfig()
    crop: CropConfig = CropConfig()
    cubemap: CubemapConfig = CubemapConfig()


@dataclass(frozen=True)
class NodeConfig(StabilizerConfig):
    """What the ROS node needs to know besides."""

    image_transport: str = option(
        'raw', 'Subscribe to image (raw), or to image/compressed, image/ffmpeg or image/foxglove',
        choices=IMAGE_TRANSPORTS, live=False)
    source: str = option(
        '', 'Read the images of a camera or stream in place of a topic: /dev/video0, rtsp://..., '
        "rtmp://, http://, udp:// and what else FFmpeg reads, a file, or '-' for standard input",
        live=False)
    source_rear: str = option(
        '', "The source of the other lens' pictures, taken at the same times as those of source, "
        'which join then puts together', live=False)
    source_options: str = option(
        '', "Options of FFmpeg for the source, NAME=VALUE,NAME=VALUE; for example a device's "
        'video_size=1920x960,framerate=30,input_format=mjpeg', live=False)
    source_frame: str = option(
        'camera', 'frame_id of the images of the source', live=False)
    stabilized_frame: str = option(
        'stabilized_optical', 'frame_id of the world in which the camera turns: optical axes, '
        "the camera's own at the first image or at the last reset", live=False)
    virtual_frame: str = option(
        'virtual_optical', 'frame_id of the stabilized sphere where smoothing turns it against '
        'the stabilized frame', live=False)
    publish_tf: bool = option(
        True, 'Publish the transforms from the camera to the stabilized frame and on to the '
        'views, where tf2_msgs is installed')
    views: tuple[str, ...] = option(
        (VIEW,), 'Names of the views: each has topics NAME/image and so on, and parameters NAME.*',
        live=False)
    front_marker: str = option(
        'none', "Which pictures show where the robot's front is",
        choices=('none', 'views', 'all'))
    front_yaw_deg: float = option(
        0., "The robot's front in the camera's frame in degrees, positive to the left of its "
        'forward axis', minimum=-360., maximum=360.)
    cmd_vel_timeout_s: float = option(
        0.5, 'How long in seconds a view goes on turning after the last cmd_vel',
        minimum=0.01, maximum=60.)
    jpeg_quality: int = option(
        90, 'Quality of the compressed images that are published', minimum=1, maximum=100)

    def __post_init__(self) -> None:
        """Check each option's value, and that the views can be told apart."""
        super().__post_init__()
        if not self.views or len(set(self.views)) < len(self.views):
            raise ConfigError('views are one or more different names')
        for name in self.views:
            # Topics and parameters begin with it.
            if not isinstance(name, str) or not re.fullmatch(VIEW_NAME, name):
                raise ConfigError(f"'{name}' cannot be a view: letters, digits and _ make a name")
            if name != VIEW and name in {*RESERVED, *(one.name for one in fields(self))}:
                raise ConfigError(f"'{name}' cannot be a view: something else has that name")


def default_view(name: str) -> ViewConfig:
    """Return the ViewConfig that the view of a name has by default."""
    return ViewConfig(frame_id=f'{name}_optical')


def view_parameters(name: str) -> dict[str, Option]:
    """Return the parameters of the view of a name: their names and Options of ViewConfig."""
    return {f'{name}.{one.name}': one for one in options(default_view(name))}


# The node's parameters by name. The tracker's have no prefix, as on the command lines.
NODE_PARAMETERS = {one.name.removeprefix('tracker.'): one for one in options(NodeConfig)}
