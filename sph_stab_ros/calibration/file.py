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

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from sph_stab_ros.config import (
    ConfigError, DUAL_FISHEYE, FisheyeConfig, options, StabilizerConfig, with_option)

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
        lines.append(f'    {"  " * len(groups)}{key}: {round(one.default, DECIMALS)!r}')
    return '\n'.join(lines) + '\n'


def read_calibration(path: Path) -> FisheyeConfig:
    """
    Return the FisheyeConfig in a file of ROS parameters; others in it are left out.

    Raises ConfigError where there is none, or a value is not allowed.
    """
    try:
        content = YAML(typ='safe', pure=True).load(path.read_text())
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"'{path}' cannot be read: "
                          f'{getattr(error, "strerror", "not a text")}') from None
    except YAMLError:
        raise ConfigError(f"'{path}' is not a YAML file") from None
    nodes = content.values() if isinstance(content, Mapping) else ()
    values = dict(pair for node in nodes if isinstance(node, Mapping)
                  for pair in _flat(node.get('ros__parameters'))
                  if pair[0].startswith(GROUP))
    if not values:
        raise ConfigError(f"'{path}' has no parameters {GROUP}*")
    config = StabilizerConfig()
    try:
        for name, value in values.items():
            config = with_option(config, name, value)
    except ConfigError as error:
        raise ConfigError(f"'{path}': {error}") from None
    return config.fisheye


def _flat(values: Any, prefix: str = '') -> Iterator[tuple[str, Any]]:
    """Yield dotted names and values of nested mappings."""
    if not isinstance(values, Mapping):
        return
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f'{prefix}{key}.')
        else:
            yield f'{prefix}{key}', value


if __name__ == '__main__':
    print(calibration_text(FisheyeConfig(), THETA_S), end='')
