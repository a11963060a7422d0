# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The calibration of two fisheye lenses as a file of the node's parameters.

``python3 -m sph_stab_ros.calibration.file > config/theta_s.yaml`` writes the one in the package.
"""

from pathlib import Path
from typing import Any

from sph_stab_ros.config import ConfigError, DUAL_FISHEYE, FISHEYE, FisheyeConfig, options
from sph_stab_ros.config.parameter_file import read_parameter_files, yaml_value
from sph_stab_ros.geometry.lens_file import is_lens_file, lens_count

THETA_S = """\
# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
#
# A Ricoh Theta S streaming live: 1280x720 over USB; 1920x1080 over HDMI is scaled to.
# The centres are those of public converters for its stream, the radius lies between theirs, and
# k1 and k2 are the mean of four such lenses that were calibrated with a checkerboard
# (RobInLab, Universitat Jaume I). `calibrate` refines this for the camera at hand.
# Written by: python3 -m sph_stab_ros.calibration.file > config/theta_s.yaml
"""
GROUP = 'fisheye.'
DECIMALS = 6


def calibration_text(config: FisheyeConfig, about: str) -> str:
    """Return the text of the file for a FisheyeConfig; ``about`` are lines of comment."""
    lines = [about, '/**:', '  ros__parameters:', f'    projection: {DUAL_FISHEYE}']
    open_groups: list[str] = []
    for one in options(config, prefix=GROUP):
        *groups, key = one.name.split('.')
        for depth, group in enumerate(groups):
            if open_groups[depth:depth + 1] != [group]:
                open_groups[depth:] = [group]
                lines.append(f'    {"  " * depth}{group}:')
        value = round(one.default, DECIMALS) if isinstance(one.default, float) else one.default
        lines.append(f'    {"  " * len(groups)}{key}: {yaml_value(value)}')
    return '\n'.join(lines) + '\n'


def read_calibration(path: Path) -> dict[str, tuple[str, Any]]:
    """
    Return those parameters of a file that say what its lenses are, as read_parameter_files does.

    Others in it are left out; a file of ROS or Kalibr is one to be read when it is used. Raises
    ConfigError where there are none.
    """
    if is_lens_file(path):
        source = f"'{path}'"
        projection = FISHEYE if lens_count(str(path)) == 1 else DUAL_FISHEYE
        return {'projection': (source, projection), GROUP + 'file': (source, str(path))}
    found = {name: given for name, given in read_parameter_files([path]).items()
             if name.startswith(GROUP)}
    if not found:
        raise ConfigError(f"'{path}' has no parameters {GROUP}*")
    return {'projection': (f"'{path}'", DUAL_FISHEYE), **found}


if __name__ == '__main__':
    print(calibration_text(FisheyeConfig(), THETA_S), end='')
