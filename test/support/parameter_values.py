# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Values for the node's parameters that are not their defaults."""

from sph_stab_ros.config import NODE_PARAMETERS

# Of those that take not just any text.
TEXTS = {'mask': 'lat:-90,-60', 'cubemap.order': 'lrfbdu', 'cubemap.turns': '012301'}


def other_value(name):
    """Return a value that a parameter takes and that is not its default."""
    option = NODE_PARAMETERS[name]
    if option.choices:
        return next(choice for choice in option.choices if choice != option.default)
    if option.minimum is not None:
        return option.maximum if option.maximum != option.default else option.minimum
    return {bool: not option.default, tuple: ['view', 'rear'],
            str: TEXTS.get(name, f'other_{name.replace(".", "_")}'),
            }[type(option.default)]
