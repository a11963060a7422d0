# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
How options are declared: default, unit, bounds and description, once each.

ROS parameters, command lines and ``config/*.yaml`` are all made from dataclasses of such options.
A nested dataclass groups its options under its name: ``view.yaw_deg``.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, TypeVar

Config = TypeVar('Config', bound='Checked')


class ConfigError(ValueError):
    """An option that does not exist or a value it does not take, in one line for the user."""


def option(default: Any, description: str, minimum: float | None = None,
           maximum: float | None = None, choices: tuple[str, ...] | None = None,
           live: bool = True) -> Any:
    """
    Declare an option of a config dataclass.

    ``live`` options may change while running; the others take effect at start-up only.
    """
    return field(default=default, metadata={
        'description': description, 'minimum': minimum, 'maximum': maximum, 'choices': choices,
        'live': live})


@dataclass(frozen=True)
class Option:
    """One option as declared: its dotted name and what ``option`` was told."""

    name: str
    default: Any
    description: str
    minimum: float | None
    maximum: float | None
    choices: tuple[str, ...] | None
    live: bool

    def check(self, value: Any) -> Any:
        """Return the value in the option's type, or raise ConfigError with the reason."""
        kind = type(self.default)
        if kind is float and type(value) is int:
            value = float(value)
        if kind is tuple and type(value) is list:
            value = tuple(value)
        if type(value) is not kind:
            wanted = 'list of names' if kind is tuple else kind.__name__
            raise ConfigError(f'{self.name} is a {wanted}, not {value!r}')
        if self.choices and value not in self.choices:
            raise ConfigError(f"{self.name} is one of {', '.join(self.choices)}, not '{value}'")
        # Written so that NaN fails too.
        if (self.minimum is not None and self.maximum is not None
                and not self.minimum <= value <= self.maximum):
            raise ConfigError(f'{self.name} must lie within {self.minimum:g} and '
                              f'{self.maximum:g}, not {value:g}')
        return value


def options(config: Any, nested: bool = True, prefix: str = '') -> Iterator[Option]:
    """
    Yield the Option of each field of a config dataclass, nested ones by their dotted names.

    Of an instance, with its values as the defaults.
    """
    for one in fields(config):
        default = getattr(config, one.name)
        if not is_dataclass(default):
            yield Option(prefix + one.name, default, **one.metadata)
        elif nested:
            yield from options(default, prefix=f'{prefix}{one.name}.')


class Checked:
    """Base of config dataclasses: refuses values that its options do not take."""

    def __post_init__(self) -> None:
        """Check each option's value."""
        for one in options(type(self), nested=False):
            object.__setattr__(self, one.name, one.check(getattr(self, one.name)))


def with_option(config: Config, name: str, value: Any) -> Config:
    """Return the config with the option of a dotted name changed, or raise ConfigError."""
    group, _, rest = name.partition('.')
    if (not is_dataclass(config) or group not in {one.name for one in fields(config)}
            or bool(rest) != is_dataclass(getattr(config, group))):
        raise ConfigError(f"there is no option '{name}'")
    return replace(config, **{group: with_option(getattr(config, group), rest, value)
                              if rest else value})


def get_option(config: Any, name: str) -> Any:
    """Return the value of the option of a dotted name."""
    for part in name.split('.'):
        config = getattr(config, part)
    return config
