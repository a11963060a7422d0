# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Choose the Projection of a stream's pictures by the config and their size."""

from sph_stab_ros.config import DUAL_FISHEYE, MIN_WIDTH, StabilizerConfig
from sph_stab_ros.geometry.equirect import is_equirect
from sph_stab_ros.geometry.fisheye import dual_fisheye, fits
from sph_stab_ros.geometry.projection import Equirect, Projection


class ProjectionError(ValueError):
    """
    A picture that is not what its projection says, in one line for the user.

    ``reason`` is one of a few fixed phrases, by which such pictures are counted.
    """

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f'{reason}: {detail}')
        self.reason = reason


def projection_of(size_wh: tuple[int, int], config: StabilizerConfig) -> Projection:
    """Return the Projection of images of a size by a config, or raise ProjectionError."""
    width, height = size_wh
    projection: Projection
    if config.projection == DUAL_FISHEYE:
        fisheye = config.fisheye
        if not fits(fisheye, (width, height)):
            raise ProjectionError(
                'not as calibrated', f'the image is {width}x{height}, the calibration of the '
                f'fisheye lenses is for {fisheye.width}x{fisheye.height}')
        projection = dual_fisheye(fisheye, (width, height))
    elif is_equirect((height, width)):
        projection = Equirect(width)
    else:
        raise ProjectionError('not 2:1', 'an equirectangular image is twice as wide as high, this '
                              f'is {width}x{height}')
    if projection.sphere_width < MIN_WIDTH:
        raise ProjectionError('unusable size', f'the sphere is {projection.sphere_width} px '
                              f'around, at least {MIN_WIDTH} are needed')
    return projection
