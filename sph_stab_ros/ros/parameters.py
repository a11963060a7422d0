# Copyright 2026 The sph_stab_ros developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The node's parameters, made from the options of NodeConfig and turned into one again."""

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

from sph_stab_ros.config import NODE_PARAMETERS, NodeConfig, with_option
from sph_stab_ros.masks import load_mask
from sph_stab_ros.trackers import working_width


def declare_parameters(node):
    """
    Declare all parameters with description, range and default; return the NodeConfig they give.

    Raises rclpy's ParameterException, ConfigError or MaskError for a value that is not allowed.
    """
    for name, option in NODE_PARAMETERS.items():
        node.declare_parameter(name, option.default, descriptor(option))
    return changed_config(NodeConfig(), node.get_parameters(list(NODE_PARAMETERS)))


def undeclared_overrides(node):
    """Return the names of parameters given at start that the node does not have."""
    return [name for name in node._parameter_overrides if not node.has_parameter(name)]


def descriptor(option):
    """Return the ParameterDescriptor of an Option."""
    return ParameterDescriptor(
        description=option.description,
        read_only=not option.live,
        additional_constraints='One of: ' + ', '.join(option.choices) if option.choices else '',
        **_range(option))


def changed_config(config, parameters):
    """
    Return the NodeConfig with the values of rclpy Parameters; those of others are left out.

    Raises ConfigError or MaskError for a value that is not allowed.
    """
    changed = config
    for parameter in parameters:
        if parameter.name in NODE_PARAMETERS:
            changed = with_option(changed, NODE_PARAMETERS[parameter.name].name, parameter.value)
    if changed.tracker != config.tracker:
        load_mask(changed.tracker.mask, working_width(changed.tracker))
    return changed


def _range(option):
    if option.minimum is None:
        return {}
    if isinstance(option.default, int):
        return {'integer_range': [IntegerRange(
            from_value=option.minimum, to_value=option.maximum, step=1)]}
    return {'floating_point_range': [FloatingPointRange(
        from_value=option.minimum, to_value=option.maximum)]}
