# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The node's parameters, made from the options in ``config`` and turned into configs again."""

from dataclasses import dataclass

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

from sph_stab_ros.config import (
    ConfigError, NODE_PARAMETERS, NodeConfig, VIEW, view_parameters, ViewConfig, with_option)
from sph_stab_ros.geometry.masks import load_mask
from sph_stab_ros.tracking import working_width


@dataclass(frozen=True)
class Settings:
    """What the parameters say: the NodeConfig, and the ViewConfig of each view by its name."""

    config: NodeConfig
    views: dict[str, ViewConfig]

    def changed(self, parameters):
        """
        Return the Settings with the values of rclpy Parameters; those of others are left out.

        Raises ConfigError or MaskError for a value that is not allowed.
        """
        config, views = self.config, dict(self.views)
        for parameter in parameters:
            view, _, option = parameter.name.partition('.')
            if view in views:
                views[view] = with_option(views[view], option, parameter.value)
            elif parameter.name in NODE_PARAMETERS:
                config = with_option(
                    config, NODE_PARAMETERS[parameter.name].name, parameter.value)
        if config.tracker != self.config.tracker:
            load_mask(config.tracker.mask, working_width(config.tracker))
        return Settings(config, views)


def declare_parameters(node):
    """
    Declare all parameters with description, range and default; return the Settings they give.

    Raises rclpy's ParameterException, ConfigError or MaskError for a value that is not allowed.
    """
    own = {name: option for name, option in NODE_PARAMETERS.items()
           if not name.startswith(f'{VIEW}.')}
    settings = Settings(NodeConfig(), {}).changed(_declare(node, own))
    of_views = {}
    for view in settings.config.views:
        of_views.update(view_parameters(view))
    views = {view: ViewConfig() for view in settings.config.views}
    settings = Settings(settings.config, views).changed(_declare(node, of_views))
    frames = [view.frame_id for view in settings.views.values()]
    frames += settings.config.stabilized_frame, settings.config.virtual_frame
    if '' in frames or len(set(frames)) < len(frames):
        raise ConfigError('stabilized_frame, virtual_frame and the frame_id of each view must be '
                          'different names')
    return settings


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


def _declare(node, options):
    """Declare parameters by their names and Options; return them."""
    return [node.declare_parameter(name, option.default, descriptor(option))
            for name, option in options.items()]


def _range(option):
    if option.minimum is None:
        return {}
    if isinstance(option.default, int):
        return {'integer_range': [IntegerRange(
            from_value=option.minimum, to_value=option.maximum, step=1)]}
    return {'floating_point_range': [FloatingPointRange(
        from_value=option.minimum, to_value=option.maximum)]}
