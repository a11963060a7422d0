# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What each projection takes: a sphere, a view and the tracker's grey sphere out of a picture."""

from functools import partial
from itertools import repeat

import cv2
from scipy.spatial.transform import Rotation

from sph_stab_ros.benchmark.calls import (
    Call, Input, medians, Progress, R_TURNED, R_VIEW, VIEW_HFOV_RAD, VIEW_SIZE_WH)
from sph_stab_ros.config import (
    CropConfig, CROPPED_EQUIRECT, CUBEMAP, DUAL_FISHEYE, EQUI_ANGULAR_CUBEMAP, EQUIRECT, FISHEYE,
    FisheyeConfig, LensConfig, StabilizerConfig, STRETCHED_EQUIRECT, TrackerConfig)
from sph_stab_ros.evaluation.report import Figures
from sph_stab_ros.geometry.arrays import Grey, Image
from sph_stab_ros.geometry.projection import Projection
from sph_stab_ros.geometry.projection_factory import projection_of
from sph_stab_ros.geometry.warp import equirect_warp, InverseWarp, perspective_warp
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.tracking import working_width

SPHERE_WIDTH = 1920
CROP = CropConfig(1920., 960., 0., 200., 1920., 560.)
ONE_LENS = FisheyeConfig(960, 960, fov_deg=200., front=LensConfig(479.5, 479.5, 430.))
# By name: the size of the picture, and the config.
PICTURES = {
    'equirect': ((1920, 960), StabilizerConfig(projection=EQUIRECT)),
    'stretched_equirect': ((1920, 1080), StabilizerConfig(projection=STRETCHED_EQUIRECT)),
    'cropped_equirect': ((1920, 560), StabilizerConfig(projection=CROPPED_EQUIRECT, crop=CROP)),
    'cubemap': ((1440, 960), StabilizerConfig(projection=CUBEMAP)),
    'equi_angular_cubemap': ((1440, 960), StabilizerConfig(projection=EQUI_ANGULAR_CUBEMAP)),
    'fisheye': ((960, 960), StabilizerConfig(projection=FISHEYE, fisheye=ONE_LENS)),
    'dual_fisheye': ((1280, 720), StabilizerConfig(projection=DUAL_FISHEYE)),
}


def projection_times(image: Image, repeats: int, progress: Progress = iter
                     ) -> dict[str, dict[str, Figures]]:
    """Return by projection and by what is read the medians of ``repeats`` calls."""
    width = working_width(TrackerConfig())
    calls: dict[str, Call] = {}
    for name, (size_wh, config) in PICTURES.items():
        projection = projection_of(size_wh, config)
        picture = cv2.resize(image, size_wh, interpolation=cv2.INTER_CUBIC)

        def warp(taken: InverseWarp, R_source_target: Rotation, _: Input,
                 picture: Image = picture, projection: Projection = projection) -> Image:
            return taken(picture, R_source_target, projection)

        def grey(_: Input, picture: Image = picture, projection: Projection = projection) -> Grey:
            return projection.grey_sphere(Frame(picture, 0), width)

        calls |= {
            f'{name}/sphere': partial(warp, equirect_warp(SPHERE_WIDTH), R_TURNED),
            f'{name}/view': partial(warp, perspective_warp(float(VIEW_HFOV_RAD), *VIEW_SIZE_WH),
                                    R_VIEW),
            f'{name}/grey': grey}
    rounds = repeat(Input(Frame(image, 0), image[..., 0], image[..., 0], image[..., 0]),
                    repeats + 1)
    taken = medians(calls, rounds, progress)
    return {name: {what: taken[f'{name}/{what}'] for what in ('sphere', 'view', 'grey')}
            for name in PICTURES}
