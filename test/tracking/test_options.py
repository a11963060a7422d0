# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""All that can be chosen about the anchored tracker is fixed once chosen, and does something."""

import ast
from dataclasses import fields, FrozenInstanceError, is_dataclass
from pathlib import Path

import pytest

import sph_stab_ros.tracking
from sph_stab_ros.tracking.anchored.options import AnchoredOptions

TRACKING = Path(sph_stab_ros.tracking.__file__).parent


def each(options):
    """Return pairs of an options object and the name of one of its values, however deep."""
    for one in fields(options):
        value = getattr(options, one.name)
        if is_dataclass(value):
            yield from each(value)
        else:
            yield options, one.name


def test_nothing_that_was_chosen_changes():
    for options, name in each(AnchoredOptions()):
        with pytest.raises(FrozenInstanceError):
            setattr(options, name, None)
    assert hash(AnchoredOptions()) == hash(AnchoredOptions())


def test_every_option_is_asked_for():
    asked = {node.attr for path in TRACKING.rglob('*.py')
             for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Attribute)}
    names = {name for _, name in each(AnchoredOptions())}
    assert len(names) > 70
    assert not names - asked
