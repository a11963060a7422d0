# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The node's parameters as YAML files: the one with all defaults written, a robot's own read.

``python3 -m sph_stab_ros.config.parameter_file > config/stabilizer.yaml``
writes the one in the package.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from textwrap import indent, wrap
from typing import Any

from sph_stab_ros.config.options import ConfigError, Option
from sph_stab_ros.config.ros_yaml import read_yaml
from sph_stab_ros.config.schema import NODE_PARAMETERS

NODE = 'stabilizer'
PARAMETERS = 'ros__parameters'
# Somebody may give a recording instead.
MOST_BYTES = 2**20

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
    lines = wrap(f'{option.description}{allowed(option)}{when}.', width=88)
    return ''.join(f'# {line}\n' for line in lines) + f'{key}: {yaml_value(option.default)}\n'


def yaml_value(value: Any) -> str:
    """Return a value as YAML has it."""
    if isinstance(value, bool):
        return str(value).lower()
    return repr(list(value) if isinstance(value, tuple) else value)


def allowed(option: Option) -> str:
    """Return what the values of an option may be, as a part of a sentence."""
    if option.choices:
        return ': ' + ', '.join(option.choices)
    return '' if option.minimum is None else f': {option.minimum:g} to {option.maximum:g}'


def read_parameter_files(paths: Iterable[Path]) -> dict[str, tuple[str, Any]]:
    """
    Return the node's parameters in files by their dotted names: the file, and the value.

    They are merged as ROS does it: node by node, in the order in which the files name them first.
    Of one node's parameters the last counts, and those of nodes named later win, whether by a
    wildcard or not. Raises ConfigError for a file that cannot be read or has nothing for the node.
    """
    nodes: dict[str, dict[str, tuple[str, Any]]] = {}
    for path in paths:
        for node, parameters in _own(path):
            nodes.setdefault(node, {}).update(
                (name, (f"'{path}'", value)) for name, value in _flat(parameters))
    return {name: found for parameters in nodes.values() for name, found in parameters.items()}


def _own(path: Path) -> list[tuple[str, dict[str, Any]]]:
    """Return the sections of a file that are for the node: names and mappings."""
    try:
        if path.is_file() and path.stat().st_size > MOST_BYTES:
            raise ConfigError('no file of parameters is that large')
        content = read_yaml(path)
        sections = [(name, parameters) for name, parameters in _sections(content or {})
                    if name.rpartition('/')[-1] in (NODE, '*', '**')]
    except ConfigError as error:
        raise ConfigError(f"'{path}': {error}") from None
    if not sections:
        raise ConfigError(f"'{path}' has no parameters of the {NODE}")
    named = {'/' + name.lstrip('/') for name, _ in sections if '*' not in name}
    if len(named) > 1:
        raise ConfigError(f"'{path}' has parameters of several nodes: {', '.join(sorted(named))}")
    return sections


def _sections(content: Any, name: str = '') -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield full names of nodes and the mappings of their parameters."""
    if not isinstance(content, dict):
        raise ConfigError(f'{name} has no {PARAMETERS}' if name else f'no {PARAMETERS}')
    for key, value in content.items():
        if key != PARAMETERS:
            yield from _sections(value, f'{name}/{key}' if name else key)
        elif isinstance(value, dict):
            yield name, value
        else:
            raise ConfigError(f'{PARAMETERS} of {name} have no names')


def _flat(values: dict[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    """Yield dotted names and values of nested mappings."""
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f'{prefix}{key}.')
        else:
            yield f'{prefix}{key}', value


if __name__ == '__main__':
    print(parameter_file(), end='')
