# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Choose the Projection of a stream's pictures by the config and their size."""

import numpy as np

from sph_stab_ros.config import (
    ConfigError, CROPPED_EQUIRECT, CUBEMAP, DUAL_FISHEYE, EQUI_ANGULAR_CUBEMAP, FISHEYE,
    FisheyeConfig, GOPRO_MAX, MIN_WIDTH, StabilizerConfig, STRETCHED_EQUIRECT)
from sph_stab_ros.geometry.cropped_equirect import cropped_equirect, CroppedEquirect
from sph_stab_ros.geometry.cubemap import cubemap, equi_angular_cubemap
from sph_stab_ros.geometry.equirect import is_equirect
from sph_stab_ros.geometry.fisheye import (
    dual_fisheye, fits, lens_ahead, single_fisheye)
from sph_stab_ros.geometry.gopro_max import gopro_max
from sph_stab_ros.geometry.lens_file import check_lens_file, with_lens_file
from sph_stab_ros.geometry.lens_model import lens_of
from sph_stab_ros.geometry.projection import Equirect, Projection

# Of sums that are those of a whole sphere.
ROUNDING = 1e-6
# Of how many fisheye lenses which projection is.
LENSES = {FISHEYE: 1, DUAL_FISHEYE: 2}


class ProjectionError(ValueError):
    """
    A picture that is not what its projection says, in one line for the user.

    ``reason`` is one of a few fixed phrases, by which such pictures are counted.
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f'{reason}: {detail}')
        self.reason = reason


def check_projection(config: StabilizerConfig) -> None:
    """Raise ConfigError where what a config says of its projection fits no picture."""
    crop = config.crop
    if config.projection == CROPPED_EQUIRECT and (
            crop.width > crop.full_width
            or crop.top + crop.height > crop.full_height * (1 + ROUNDING)):
        raise ConfigError('crop.width and crop.height reach beyond the whole sphere')
    if config.projection not in LENSES:
        return
    count = LENSES[config.projection]
    check_lens_file(config.fisheye, count)
    fisheye = with_lens_file(config.fisheye, (0, 0))
    if count == 2 and 90 + np.rad2deg(np.arctan(lens_ahead(fisheye))) > fisheye.fov_deg / 2:
        raise ConfigError(
            f'what is so near as fisheye.seam_distance_m, {fisheye.seam_distance_m:g}, neither '
            'lens sees at the border: fisheye.baseline_m is too large for fisheye.fov_deg')
    for name in ('front', 'rear')[:count]:
        if not lens_of(getattr(fisheye, name), fisheye.model).tells_apart(
                np.deg2rad(fisheye.fov_deg / 2)):
            raise ConfigError(
                f'the distortion of the {name} lens turns back before {fisheye.fov_deg / 2:g} '
                'degrees, half of fisheye.fov_deg')


def projection_of(size_wh: tuple[int, int], config: StabilizerConfig) -> Projection:
    """Return the Projection of images of a size by a config, or raise ProjectionError."""
    projection = _projection(size_wh, config)
    if projection.sphere_width < MIN_WIDTH:
        raise ProjectionError('unusable size', f'the sphere is {projection.sphere_width} px '
                              f'around, at least {MIN_WIDTH} are needed')
    return projection


def _projection(size_wh: tuple[int, int], config: StabilizerConfig) -> Projection:
    width, height = size_wh
    if config.projection in LENSES:
        return _of_lenses(config.fisheye, size_wh, config.projection)
    if config.projection == STRETCHED_EQUIRECT:
        return CroppedEquirect(size_wh)
    if config.projection == CROPPED_EQUIRECT:
        return cropped_equirect(config.crop, size_wh)
    if config.projection == EQUI_ANGULAR_CUBEMAP:
        return equi_angular_cubemap(size_wh)
    if config.projection == GOPRO_MAX:
        both = gopro_max(size_wh)
        if both is None:
            raise ProjectionError(
                'not a GoPro Max', 'its two tracks, one above the other (join), make 4096x2688 '
                f'or 2272x1472, this is {width}x{height}')
        return both
    if config.projection == CUBEMAP:
        found = cubemap(config.cubemap.order, config.cubemap.turns, size_wh)
        if found is None:
            raise ProjectionError('not a cubemap', 'six square faces lie 3x2, 6x1, 1x6 or 4x3, '
                                  f'this is {width}x{height}')
        return found
    if abs(width - 2 * height) == 1:
        # As near as odd numbers of columns come.
        return CroppedEquirect(size_wh)
    if not is_equirect((height, width)):
        raise ProjectionError('not 2:1', 'an equirectangular image is twice as wide as high, this '
                              f'is {width}x{height}; -p projection:=... says what else it shows')
    return Equirect(width)


def _of_lenses(config: FisheyeConfig, size_wh: tuple[int, int], projection: str) -> Projection:
    try:
        fisheye = with_lens_file(config, size_wh)
    except ConfigError as error:
        raise ProjectionError('no calibration', str(error)) from None
    if not fits(fisheye, size_wh):
        raise ProjectionError(
            'not as calibrated', f'the image is {size_wh[0]}x{size_wh[1]}, the calibration of the '
            f'fisheye lenses is for {fisheye.width}x{fisheye.height}')
    return (dual_fisheye if projection == DUAL_FISHEYE else single_fisheye)(fisheye, size_wh)
