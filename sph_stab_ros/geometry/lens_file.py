# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Calibrations of fisheye lenses as ROS (camera_info) and Kalibr (camchain) write them."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import ConfigError, EQUIDISTANT, FisheyeConfig, LensConfig
from sph_stab_ros.config.ros_yaml import read_yaml
from sph_stab_ros.geometry.fisheye import fits

# By which names the model of Kannala and Brandt goes in them.
POLYNOMIAL = ('equidistant', 'fisheye', 'equi')
# The place of the second lens' picture: right of the first one's, or below it.
SIDES = ((1, 0), (0, 1))
# A picture's size, and options of LensConfig.
Lens: TypeAlias = tuple[tuple[int, int], dict[str, float]]


def is_lens_file(path: Path) -> bool:
    """Tell whether a file is a calibration of ROS or Kalibr, not one of a node's parameters."""
    try:
        content = read_yaml(path)
    except ConfigError:
        return False
    return isinstance(content, dict) and ('camera_matrix' in content or 'cam0' in content)


def lens_count(path: str) -> int:
    """Return of how many lenses a file is the calibration, or raise ConfigError."""
    return len(_lenses(path))


def check_lens_file(config: FisheyeConfig, lenses: int) -> None:
    """Raise ConfigError where a FisheyeConfig has a file that is not of so many lenses."""
    if config.file and lens_count(config.file) != lenses:
        raise ConfigError(f"'{config.file}' is a calibration of {lens_count(config.file)} "
                          f'lenses, the projection has {lenses}')


def with_lens_file(config: FisheyeConfig, size_wh: tuple[int, int]) -> FisheyeConfig:
    """
    Return a FisheyeConfig with what its file says, or as it is without a file.

    Pictures (width, height) show two lenses side by side or one above the other, whichever fits.
    """
    if not config.file:
        return config
    lenses = _lenses(config.file)
    try:
        return _with_lenses(config, lenses, size_wh)
    except ConfigError as error:
        raise ConfigError(f"'{config.file}' cannot be used as a calibration: {error}") from None


def _with_lenses(config: FisheyeConfig, lenses: list[Lens], size_wh: tuple[int, int]
                 ) -> FisheyeConfig:
    (front_wh, front), *others = lenses
    as_camera = {'yaw_deg': 0., 'pitch_deg': 0., 'roll_deg': 0.}
    width, height = front_wh
    config = replace(config, width=width, height=height, file='', model=EQUIDISTANT,
                     front=LensConfig(**front | as_camera))
    if not others:
        return config
    _, rear = others[0]
    options = []
    for right, below in SIDES:
        moved = {'center_u_px': rear['center_u_px'] + width * right,
                 'center_v_px': rear['center_v_px'] + height * below}
        options.append(replace(config, width=width * (1 + right), height=height * (1 + below),
                               rear=LensConfig(**rear | moved)))
    return next((one for one in options if fits(one, size_wh)), options[0])


@lru_cache(maxsize=4)
def _lenses(path: str) -> list[Lens]:
    """Return each Lens in a file."""
    try:
        content = read_yaml(Path(path))
        if not isinstance(content, dict):
            raise ConfigError('no calibration')
        if 'camera_matrix' in content:
            return [_of_ros(content)]
        return _of_kalibr(content)
    except KeyError as error:
        reason = f'no {error.args[0]} in it'
    except ConfigError as error:
        reason = str(error)
    except (TypeError, ValueError, ArithmeticError, LookupError, AttributeError):
        reason = 'numbers that are none'
    raise ConfigError(f"'{path}' cannot be read as a calibration: {reason}")


def _of_ros(info: Mapping[str, Any]) -> Lens:
    fx, _, cx, _, fy, cy, *_ = info['camera_matrix']['data']
    return ((int(info['image_width']), int(info['image_height'])), _lens(
        info['distortion_model'], (fx, fy, cx, cy), info['distortion_coefficients']['data']))


def _of_kalibr(chain: Mapping[str, Any]) -> list[Lens]:
    lenses: list[Lens] = []
    for name in ('cam0', 'cam1'):
        if name not in chain and name != 'cam0':
            continue
        camera = chain[name]
        if camera['camera_model'] != 'pinhole':
            raise ConfigError(f"the camera model '{camera['camera_model']}' is not read, pinhole "
                              'with equidistant distortion is')
        lens = _lens(
            camera['distortion_model'], camera['intrinsics'], camera['distortion_coeffs'])
        if lenses:
            R_rear_front = Rotation.from_matrix(np.array(camera['T_cn_cnm1'], float)[:3, :3])
            yaw, pitch, roll = R_rear_front.inv().as_euler('YXZ', degrees=True).tolist()
            lens |= {'yaw_deg': -yaw, 'pitch_deg': pitch, 'roll_deg': roll}
        width, height = camera['resolution']
        lenses.append(((int(width), int(height)), lens))
    return lenses


def _lens(model: str, intrinsics: Any, coefficients: Any) -> dict[str, float]:
    """Return the options of LensConfig, without those of the mount."""
    if model not in POLYNOMIAL:
        raise ConfigError(f"the distortion model '{model}' is not read, equidistant is")
    fx, fy, cx, cy = map(float, intrinsics)
    k1, k2, k3, k4 = map(float, coefficients)
    t = np.pi / 2
    at_90 = t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8)
    return {'center_u_px': cx, 'center_v_px': cy, 'radius_px': float(fx * at_90), 'k1': k1,
            'k2': k2, 'k3': k3, 'k4': k4, 'aspect': fy / fx}
