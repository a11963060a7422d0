# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The node's parameters on a command line: from files, by ``-p``, and by shorthands for some.

Names, values and their limits are those of ``config``. Files are merged as ROS does it; what
stands on the command line itself wins over them, and there the later over the earlier.
"""

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from sph_stab_ros.calibration.file import read_calibration
from sph_stab_ros.config import (
    ConfigError, NODE_PARAMETERS, options, Settings, settings_of, TrackerConfig)
from sph_stab_ros.config.parameter_file import read_parameter_files
from sph_stab_ros.config.ros_yaml import parse_yaml
from sph_stab_ros.geometry.masks import MaskError
from sph_stab_ros.geometry.projection_factory import check_projection
from sph_stab_ros.tracking import check_mask

TRACKER_OPTIONS = tuple(option.name for option in options(TrackerConfig))

# By their names: where they are from, and their values.
Parameters = dict[str, tuple[str, Any]]


class SetParameters(argparse.Action):
    """An argument that sets the Parameters which ``read(text, flag)`` returns."""

    def __init__(self, *args: Any, read: Callable[[Any, str], Parameters], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._read = read

    def __call__(self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, text: Any,
                 option_string: str | None = None) -> None:
        """Take them over those set so far, and keep the text."""
        try:
            found = self._read(text, option_string or self.dest)
        except ConfigError as error:
            raise argparse.ArgumentError(self, str(error)) from None
        namespace.parameters = namespace.parameters | found
        setattr(namespace, self.dest, text)


def add_parameters(parser: argparse.ArgumentParser, about: str) -> argparse._ArgumentGroup:
    """
    Add arguments for all parameters of the node; return their group, for shorthands to come.

    ``about`` says which of them the command heeds.
    """
    parser.set_defaults(parameters={})
    group = parser.add_argument_group(
        "the node's parameters", f'{about}; config/stabilizer.yaml describes them all. What '
        'stands on the command line wins over files, and the later over the earlier.')
    group.add_argument(
        '--params-file', metavar='FILE.yaml', type=Path, action='append', default=[],
        help='take them from a file as ros2 run does, sections for other nodes left out; may be '
        'repeated')
    group.add_argument(
        '-p', metavar='NAME:=VALUE', action=SetParameters, read=_assignment,
        help='set one as ros2 run does, for example -p view.width:=1280; may be repeated')
    return group


def add_shorthands(group: argparse._ArgumentGroup, names: Iterable[str]) -> None:
    """Add an argument for each parameter of these names: ``--working-width`` and so on."""
    for name in names:
        option = NODE_PARAMETERS[name]
        kind = type(option.default)

        def read(text: str, flag: str, name: str = name, kind: type = kind) -> Parameters:
            try:
                return {name: (flag, kind(text))}
            except ValueError:
                # The option says what it takes.
                return {name: (flag, text)}

        group.add_argument(
            '--' + name.replace('_', '-'), action=SetParameters, read=read,
            metavar='|'.join(option.choices or ()) or {int: 'N', float: 'X', str: 'TEXT'}[kind],
            help=option.description + (f' (default: {option.default})' if option.default != ''
                                       else ''))


def add_calibration(group: argparse._ArgumentGroup) -> None:
    """Add an argument for a file of which only the calibration of the lenses is taken."""
    group.add_argument(
        '--calibration', metavar='FILE.yaml', action=SetParameters,
        read=lambda text, _: read_calibration(Path(text)),
        help='take the parameters fisheye.* from a file that calibrate wrote, or the lenses from '
        'one of ROS (camera_info) or Kalibr (camchain); the pictures are then dual_fisheye, or '
        'fisheye where it has one lens (default: a Theta S)')


def given_parameters(parser: argparse.ArgumentParser, args: argparse.Namespace) -> Parameters:
    """Return what parsed arguments say of parameters; exit 2 where a file is unreadable."""
    try:
        from_files: Parameters = read_parameter_files(args.params_file)
    except ConfigError as error:
        parser.error(f'--params-file: {error}')
    given: Parameters = args.parameters
    return from_files | given


def settings_from(parser: argparse.ArgumentParser, parameters: Parameters) -> Settings:
    """Return the Settings that Parameters give; exit 2 where one is not allowed."""
    try:
        settings = settings_of(parameters)
        check_projection(settings.config)
    except ConfigError as error:
        parser.error(str(error))
    refuse_bad_mask(parser, parameters, settings.config.tracker)
    return settings


def refuse_bad_mask(parser: argparse.ArgumentParser, parameters: Parameters,
                    config: TrackerConfig) -> None:
    """Exit 2 where the mask of a TrackerConfig, given by Parameters, cannot be used."""
    try:
        check_mask(config)
    except MaskError as error:
        parser.error(f'{parameters["mask"][0]}: {error}')


def _assignment(text: str, flag: str) -> Parameters:
    """Return the parameter in ``NAME:=VALUE``."""
    name, assigned, value = text.partition(':=')
    if not (name and assigned and value):
        raise ConfigError(f"'{text}' is not NAME:=VALUE")
    try:
        return {name: (flag, parse_yaml(value))}
    except ConfigError as error:
        raise ConfigError(f'{name}: {error}') from None
