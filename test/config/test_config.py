# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Options: declared once, checked always, and written out as the node's YAML file."""

from pathlib import Path

import pytest

from sph_stab_ros.config import (
    ConfigError, get_option, NODE_PARAMETERS, NodeConfig, options, StabilizerConfig, with_option)
from sph_stab_ros.config.parameter_file import parameter_file

ROOT = Path(__file__).resolve().parents[2]
ALL = list(options(NodeConfig))


@pytest.mark.parametrize('option', ALL, ids=lambda option: option.name)
def test_options_are_complete_and_round_trip(option):
    assert option.description and not option.description.endswith('.')
    assert option.check(option.default) == option.default
    assert get_option(NodeConfig(), option.name) == option.default
    assert with_option(NodeConfig(), option.name, option.default) == NodeConfig()
    numeric = type(option.default) in (int, float)
    assert numeric == (option.minimum is not None) == (option.maximum is not None)


@pytest.mark.parametrize('option', [one for one in ALL if one.minimum is not None],
                         ids=lambda option: option.name)
def test_limits_are_part_of_the_range(option):
    for limit in (option.minimum, option.maximum):
        assert get_option(with_option(NodeConfig(), option.name, limit), option.name) == limit
    for beyond in (option.minimum - 1, option.maximum + 1):
        with pytest.raises(ConfigError, match=option.name.rpartition('.')[-1]):
            with_option(NodeConfig(), option.name, beyond)


@pytest.mark.parametrize('name, value, reason', (
    ('tracker.estimator', 'best', 'estimator is one of'),
    ('view.yaw_deg', float('nan'), 'must lie within'),
    ('view.width', 10.5, 'width is a int'),
    ('view.width', True, 'width is a int'),
    ('tracker.mask', 3, 'mask is a str'),
    ('view.zoom', 1, "no option 'zoom'"),
    ('nothing', 1, "no option 'nothing'"),
))
def test_wrong_values_are_refused_with_the_reason(name, value, reason):
    with pytest.raises(ConfigError, match=reason):
        with_option(NodeConfig(), name, value)


def test_whole_numbers_do_for_fractions():
    config = with_option(StabilizerConfig(), 'view.yaw_deg', 30)
    assert type(config.view.yaw_deg) is float


def test_parameters_have_names_of_their_own():
    assert len(NODE_PARAMETERS) == len(ALL)
    assert {'estimator', 'flow', 'mask', 'view.yaw_deg'} <= NODE_PARAMETERS.keys()


def test_the_yaml_file_is_the_one_that_the_options_give():
    written = (ROOT / 'config' / 'stabilizer.yaml').read_text()
    assert written == parameter_file(), (
        'run: python3 -m sph_stab_ros.config.parameter_file > config/stabilizer.yaml')
