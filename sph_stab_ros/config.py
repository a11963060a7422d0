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

"""
Every option once: default, unit, bounds and description.

ROS parameters, command lines and ``config/*.yaml`` are all made from these dataclasses. A nested
dataclass groups its options under its name: ``view.yaw_deg``.
"""

from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

from sph_stab_ros.flow import FLOWS
from sph_stab_ros.image_pair import METHODS


ANCHORED = 'anchored'
# Narrower spheres show too little.
MIN_WIDTH = 128


class ConfigError(ValueError):
    """An option that does not exist or a value it does not take, in one line for the user."""


def option(default, description, minimum=None, maximum=None, choices=None, live=True):
    """
    Declare an option of a config dataclass.

    ``live`` options may change while running; the others take effect at start-up only.
    """
    return field(default=default, metadata={
        'description': description, 'minimum': minimum, 'maximum': maximum, 'choices': choices,
        'live': live})


@dataclass(frozen=True)
class Option:
    """One option as declared: its dotted name and what ``option`` was told."""

    name: str
    default: Any
    description: str
    minimum: float | None
    maximum: float | None
    choices: tuple | None
    live: bool

    def check(self, value):
        """Return the value in the option's type, or raise ConfigError with the reason."""
        kind = type(self.default)
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is not kind:
            raise ConfigError(f'{self.name} is a {kind.__name__}, not {value!r}')
        if self.choices and value not in self.choices:
            raise ConfigError(f"{self.name} is one of {', '.join(self.choices)}, not '{value}'")
        # Written so that NaN fails too.
        if self.minimum is not None and not self.minimum <= value <= self.maximum:
            raise ConfigError(f'{self.name} must lie within {self.minimum:g} and '
                              f'{self.maximum:g}, not {value:g}')
        return value


def options(config_class, nested=True, prefix=''):
    """Yield the Option of each field of a config dataclass, nested ones by their dotted names."""
    for one in fields(config_class):
        if not is_dataclass(one.default):
            yield Option(prefix + one.name, one.default, **one.metadata)
        elif nested:
            yield from options(type(one.default), prefix=f'{prefix}{one.name}.')


class Checked:
    """Base of config dataclasses: refuses values that its options do not take."""

    def __post_init__(self):
        """Check each option's value."""
        for one in options(type(self), nested=False):
            object.__setattr__(self, one.name, one.check(getattr(self, one.name)))


@dataclass(frozen=True)
class TrackerConfig(Checked):
    """How the rotation is estimated."""

    estimator: str = option(
        ANCHORED, 'Estimator of the rotation: anchored to keyframes, or one of the paper, chained '
        'from frame to frame', choices=(ANCHORED, *METHODS))
    flow: str = option('farneback', "Dense optical flow of the paper's estimators",
                       choices=tuple(FLOWS))
    flow_updates: int = option(
        0, 'How often the flow is computed again on the derotated image', minimum=0, maximum=5)
    epipolar_bound_deg: float = option(
        30., 'Angle in degrees at which flow off its epipolar circle counts a quarter in '
        "pts_epipolar; 180 for the paper's plain sum of squares",
        minimum=1., maximum=180.)
    working_width: int = option(
        0, 'Width in pixels that images are reduced to for the estimator, at least 128; 0 leaves '
        'it to the estimator: 960 for anchored, 480 for the others', minimum=0, maximum=3840)
    mask: str = option(
        '', "Pixels not to use: path of a 2:1 image (black) or 'lat:FROM,TO' in degrees")
    max_prediction_s: float = option(
        0.5, 'For how long in seconds the last angular velocity is trusted without measurement',
        minimum=0., maximum=10.)

    def __post_init__(self):
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


@dataclass(frozen=True)
class StabilizerConfig:
    """What the stabiliser needs to know."""

    tracker: TrackerConfig = TrackerConfig()
    view: ViewConfig = ViewConfig()


@dataclass(frozen=True)
class NodeConfig(Checked, StabilizerConfig):
    """What the ROS node needs to know besides."""

    image_transport: str = option(
        'raw', 'Subscribe to image (raw) or to image/compressed', choices=('raw', 'compressed'),
        live=False)
    stabilized_frame: str = option(
        'stabilized_optical', 'frame_id of the world in which the camera turns: optical axes, '
        "the camera's own at the first image or at the last reset", live=False)
    view_frame: str = option(
        'view_optical', 'frame_id of the virtual camera', live=False)
    jpeg_quality: int = option(
        90, 'Quality of the compressed images that are published', minimum=1, maximum=100)


def with_option(config, name, value):
    """Return the config with the option of a dotted name changed, or raise ConfigError."""
    group, _, rest = name.partition('.')
    if group not in {one.name for one in fields(config)}:
        raise ConfigError(f"there is no option '{name}'")
    return replace(config, **{group: with_option(getattr(config, group), rest, value)
                              if rest else value})


def get_option(config, name):
    """Return the value of the option of a dotted name."""
    for part in name.split('.'):
        config = getattr(config, part)
    return config


# The node's parameters by name. The tracker's have no prefix, as on the command lines.
NODE_PARAMETERS = {one.name.removeprefix('tracker.'): one for one in options(NodeConfig)}
