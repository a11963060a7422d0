# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Options of how a picture shows the sphere."""

from dataclasses import dataclass
import re

from sph_stab_ros.config.options import Checked, ConfigError, option

EQUIRECT = 'equirect'
DUAL_FISHEYE = 'dual_fisheye'
STRETCHED_EQUIRECT = 'stretched_equirect'
CROPPED_EQUIRECT = 'cropped_equirect'
CUBEMAP = 'cubemap'
EQUI_ANGULAR_CUBEMAP = 'equi_angular_cubemap'
FISHEYE = 'fisheye'
GOPRO_MAX = 'gopro_max'
PROJECTIONS = (EQUIRECT, DUAL_FISHEYE, STRETCHED_EQUIRECT, CROPPED_EQUIRECT, CUBEMAP,
               EQUI_ANGULAR_CUBEMAP, FISHEYE, GOPRO_MAX)
EQUIDISTANT = 'equidistant'
EQUISOLID = 'equisolid'
LENS_MODELS = (EQUIDISTANT, EQUISOLID)
# Narrower spheres show too little.
MIN_WIDTH = 128


@dataclass(frozen=True)
class LensConfig(Checked):
    """One lens of two: where its circle is in the picture, how it bends, where it looks."""

    center_u_px: float = option(
        319.5, 'Column of the centre of its circle', minimum=-10000., maximum=10000.)
    center_v_px: float = option(
        319.5, 'Row of the centre of its circle', minimum=-10000., maximum=10000.)
    radius_px: float = option(
        285., 'Distance from the centre in pixels of what lies 90 degrees off the axis',
        minimum=16., maximum=10000.)
    k1: float = option(
        -0.002, 'Distortion: what lies t radians off the axis is seen at a distance that goes '
        'with t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8), as in the fisheye model of OpenCV; of an '
        'equisolid lens t is 2 sin of half the angle', minimum=-1., maximum=1.)
    k2: float = option(-0.005, 'Distortion, second term', minimum=-1., maximum=1.)
    yaw_deg: float = option(
        0., "Where its axis looks in the camera's frame in degrees, positive to the left",
        minimum=-360., maximum=360.)
    pitch_deg: float = option(
        0., 'Where its axis looks in degrees, positive up', minimum=-90., maximum=90.)
    roll_deg: float = option(
        90., 'How far it is turned about its axis in degrees, positive clockwise as it looks',
        minimum=-360., maximum=360.)
    k3: float = option(0., 'Distortion, third term', minimum=-1., maximum=1.)
    k4: float = option(0., 'Distortion, fourth term', minimum=-1., maximum=1.)
    aspect: float = option(
        1., 'How high its circle is to its width: pixels that are not square',
        minimum=0.1, maximum=10.)


@dataclass(frozen=True)
class FisheyeConfig(Checked):
    """
    The calibration of a camera that shows two fisheye circles; by default a Theta S.

    Of one that shows a single circle, the front lens is it.
    """

    width: int = option(
        1280, 'Width of the pictures that the pixels below are counted in; those of others are '
        'scaled', minimum=MIN_WIDTH, maximum=16384)
    height: int = option(
        720, 'Height of the pictures that the pixels below are counted in',
        minimum=64, maximum=16384)
    fov_deg: float = option(
        190., 'Field of view of each lens in degrees', minimum=180., maximum=280.)
    blend_deg: float = option(
        6., 'Width in degrees of the band in which one lens fades into the other; at most what '
        'both see', minimum=0., maximum=90.)
    front: LensConfig = LensConfig()
    rear: LensConfig = LensConfig(center_u_px=959.5, yaw_deg=180., roll_deg=-90.)
    model: str = option(
        EQUIDISTANT, 'What the distance from the centre goes with, but for distortion: the angle '
        'off the axis, or the sine of half of it', choices=LENS_MODELS)
    stretched: bool = option(
        False, 'Pictures of another aspect than width to height are stretched ones')
    match_lenses: bool = option(
        False, 'Make two lenses as bright and as coloured as each other near their border, by '
        'what both see')
    baseline_m: float = option(
        0., 'How far apart in metres the centres of two lenses are, each ahead along its axis of '
        'the middle between', minimum=0., maximum=10.)
    seam_distance_m: float = option(
        0., 'How far away in metres is what two lenses show without a step where one ends and the '
        'other begins; 0: infinitely far', minimum=0., maximum=1e6)
    file: str = option(
        '', 'Path of a calibration as ROS (camera_info of the model equidistant) or Kalibr '
        '(camchain) write it: it takes the place of the pixels and distortions, and of the rear '
        'mount where it has two lenses')


@dataclass(frozen=True)
class CropConfig(Checked):
    """Which part of a sphere the pictures show, in any unit: pixels as GPano has them, shares."""

    full_width: float = option(
        1., 'Width of the whole sphere (FullPanoWidthPixels)', minimum=1e-3, maximum=1e6)
    full_height: float = option(
        1., 'Height of the whole sphere (FullPanoHeightPixels)', minimum=1e-3, maximum=1e6)
    left: float = option(
        0., 'Where in it the pictures begin (CroppedAreaLeftPixels); they may go on around it',
        minimum=0., maximum=1e6)
    top: float = option(
        0., 'Where in it the pictures begin (CroppedAreaTopPixels)', minimum=0., maximum=1e6)
    width: float = option(
        1., 'How wide a part of it they show (CroppedAreaImageWidthPixels)',
        minimum=1e-3, maximum=1e6)
    height: float = option(
        1., 'How high a part of it they show (CroppedAreaImageHeightPixels)',
        minimum=1e-3, maximum=1e6)


@dataclass(frozen=True)
class CubemapConfig(Checked):
    """Which face of a cube is where; by default the usual layouts."""

    order: str = option(
        '', 'Faces row by row by their letters r, l, u, d, f, b, as in_forder of FFmpeg has them; '
        'empty: rludfb, or ulfrbd of the cross 4x3')
    turns: str = option(
        '', 'By how many quarters each of them is turned clockwise, as in_frot of FFmpeg has it; '
        'empty: 000000')

    def __post_init__(self) -> None:
        """Check each option's value."""
        super().__post_init__()
        if self.order and sorted(self.order) != sorted('rludfb'):
            raise ConfigError(
                f"cubemap.order has each of r, l, u, d, f, b once, not '{self.order}'")
        if self.turns and not re.fullmatch('[0-3]{6}', self.turns):
            raise ConfigError(f"cubemap.turns is six digits 0 to 3, not '{self.turns}'")
