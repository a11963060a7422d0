# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The node's parameters, made from the options in config and turned into configs again."""

from collections.abc import Iterable, Mapping
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter
from sph_stab_ros.config import Settings, VIEW
from sph_stab_ros.config.options import Option
from sph_stab_ros.geometry.projection_factory import check_projection
from sph_stab_ros.tracking import check_mask


def changed(settings: Settings, parameters: Iterable[Parameter]) -> Settings:
    """
    Return Settings with the values of rclpy Parameters; those of others are left out.

    Raises ConfigError or MaskError for a value that is not allowed.
    """
    known = settings.parameters
    new = settings.changed({one.name: one.value for one in parameters if one.name in known})
    if new.config.tracker != settings.config.tracker:
        check_mask(new.config.tracker)
    check_projection(new.config)
    return new


def declare_parameters(node: Node) -> Settings:
    """
    Declare all parameters with description, range and default; return the Settings they give.

    Raises rclpy's ParameterException, ConfigError or MaskError for a value that is not allowed.
    """
    settings = Settings()
    own = {name: option for name, option in settings.parameters.items()
           if not name.startswith(f'{VIEW}.')}
    settings = changed(settings, _declare(node, own))
    # Only now it is known which views there are.
    settings = changed(settings, _declare(node, {
        name: option for name, option in settings.parameters.items() if name not in own}))
    settings.check_frames()
    return settings


def undeclared_overrides(node: Node) -> list[str]:
    """
    Return the names of parameters given at start that the node does not have.

    A file of all defaults describes the view that there is by default, used or not.
    """
    return [name for name in node._parameter_overrides
            if not node.has_parameter(name) and not name.startswith(f'{VIEW}.')]


def descriptor(option: Option) -> ParameterDescriptor:
    """Return the ParameterDescriptor of an Option."""
    return ParameterDescriptor(
        description=option.description,
        read_only=not option.live,
        additional_constraints='One of: ' + ', '.join(option.choices) if option.choices else '',
        **_range(option))


def _declare(node: Node, options: Mapping[str, Option]) -> list[Parameter]:
    """Declare parameters by their names and Options; return them."""
    return [node.declare_parameter(name, option.default, descriptor(option))
            for name, option in options.items()]


def _range(option: Option) -> dict[str, Any]:
    if option.minimum is None:
        return {}
    if isinstance(option.default, int):
        return {'integer_range': [IntegerRange(
            from_value=option.minimum, to_value=option.maximum, step=1)]}
    return {'floating_point_range': [FloatingPointRange(
        from_value=option.minimum, to_value=option.maximum)]}
