# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the node's parameters say together: its config, and that of each view it names."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from sph_stab_ros.config.options import ConfigError, Option, with_option
from sph_stab_ros.config.schema import (
    default_view, NODE_PARAMETERS, NodeConfig, VIEW, view_parameters, ViewConfig)

# Of rclpy, in any node.
NOT_OURS = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')


@dataclass(frozen=True)
class Settings:
    """The NodeConfig, and the ViewConfig of each view by its name; ``config.view`` is not used."""

    config: NodeConfig = NodeConfig()
    views: dict[str, ViewConfig] = field(default_factory=lambda: {VIEW: default_view(VIEW)})

    @property
    def parameters(self) -> dict[str, Option]:
        """Return the Options by the names of their parameters."""
        found = {name: option for name, option in NODE_PARAMETERS.items()
                 if not name.startswith(f'{VIEW}.')}
        for view in self.views:
            found.update(view_parameters(view))
        return found

    def changed(self, values: Mapping[str, Any]) -> 'Settings':
        """
        Return the Settings with other values of parameters; those of new views are the defaults.

        Raises ConfigError for a name that there is not or a value that is not allowed.
        """
        config = self.config
        of_views = {}
        for name, value in values.items():
            if name not in NODE_PARAMETERS or name.startswith(f'{VIEW}.'):
                of_views[name] = value
                continue
            option = NODE_PARAMETERS[name]
            replace(option, name=name).check(value)
            config = with_option(config, option.name, value)
        views = {view: self.views.get(view, default_view(view)) for view in config.views}
        for name, value in of_views.items():
            view, _, key = name.partition('.')
            # A file of all defaults describes the view that there is by default, used or not.
            parameters = view_parameters(view) if view in {*views, VIEW} else {}
            if name not in parameters:
                raise ConfigError(f"there is no parameter '{name}'")
            replace(parameters[name], name=name).check(value)
            if view in views:
                views[view] = with_option(views[view], key, value)
        return Settings(config, views)

    def check_frames(self) -> None:
        """Raise ConfigError unless all frames that are published can be told apart."""
        frames = [frame_in_tf(one) for one in (
            self.config.stabilized_frame, self.config.virtual_frame,
            *(view.frame_id for view in self.views.values()))]
        if '' in frames or len(set(frames)) < len(frames):
            raise ConfigError('stabilized_frame, virtual_frame and the frame_id of each view must '
                              'be different names')


def frame_in_tf(frame_id: str) -> str:
    """Return the name of a frame as tf2 takes it, which knows of no slash before it."""
    return frame_id.removeprefix('/')


def settings_of(parameters: Mapping[str, tuple[str, Any]]) -> Settings:
    """
    Return the Settings of parameters by name, each where it is from and its value.

    What any node of ROS may be told besides is left out. Raises ConfigError, which names where
    the parameter is from that there is not or whose value is not allowed.
    """
    settings = Settings()
    # The views come first: the others may be theirs.
    for name in sorted(parameters, key=lambda name: name != 'views'):
        source, value = parameters[name]
        if name.startswith(NOT_OURS):
            continue
        try:
            settings = settings.changed({name: value})
        except ConfigError as error:
            raise ConfigError(f'{source}: {error}') from None
    settings.check_frames()
    return settings
