# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The operator's server where aioquic is not installed."""

import logging
import sys

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')
pytest.importorskip('aiohttp', reason='aiohttp is not installed')
from sph_stab_ros.operator.__main__ import datagrams  # noqa: E402, I100


class Missing:
    """Finds no aioquic."""

    @staticmethod
    def find_spec(name, *_):
        """Say so."""
        if name == 'aioquic':
            raise ModuleNotFoundError(f'No module named {name!r}', name=name)


def test_it_says_so_and_does_without(monkeypatch, caplog):
    monkeypatch.setattr(sys, 'meta_path', [Missing, *sys.meta_path])
    for name in tuple(sys.modules):
        if name.split('.')[0] == 'aioquic' or name == 'sph_stab_ros.operator.datagrams':
            monkeypatch.delitem(sys.modules, name)
    with caplog.at_level(logging.INFO, 'operator'):
        assert datagrams(lambda kind, text: None) is None
    line, = caplog.messages
    assert 'sph_stab_ros[datagrams]' in line
