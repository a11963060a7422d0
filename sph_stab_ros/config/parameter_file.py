# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The node's parameters and their defaults as a YAML file.

``python3 -m sph_stab_ros.config.parameter_file > config/stabilizer.yaml``
writes the one in the package.
"""

from textwrap import indent, wrap
from typing import Any

from sph_stab_ros.config import NODE_PARAMETERS, Option

HEADER = """\
# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
#
# All parameters of the stabilizer node and their defaults.
# Written by: python3 -m sph_stab_ros.config.parameter_file > config/stabilizer.yaml

/**:
  ros__parameters:
"""


def parameter_file() -> str:
    """Return the text of the YAML file."""
    groups: dict[str, list[str]] = {}
    for name, option in NODE_PARAMETERS.items():
        group, _, key = name.rpartition('.')
        groups.setdefault(group, []).append(_entry(key, option))
    text = '\n'.join(groups.pop(''))
    for group, entries in groups.items():
        text += f'\n{group}:\n' + indent('\n'.join(entries), '  ')
    return HEADER + indent(text, '    ')


def _entry(key: str, option: Option) -> str:
    """Return the lines of one option: description, allowed values, default."""
    when = '' if option.live else ' (at start only)'
    lines = wrap(f'{option.description}{_allowed(option)}{when}.', width=88)
    return ''.join(f'# {line}\n' for line in lines) + f'{key}: {_yaml(option.default)}\n'


def _yaml(value: Any) -> str:
    """Return a value as YAML has it."""
    if isinstance(value, bool):
        return str(value).lower()
    return repr(list(value) if isinstance(value, tuple) else value)


def _allowed(option: Option) -> str:
    if option.choices:
        return ': ' + ', '.join(option.choices)
    return '' if option.minimum is None else f': {option.minimum:g} to {option.maximum:g}'


if __name__ == '__main__':
    print(parameter_file(), end='')
