# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The public API: what the package names is there, and nothing is imported before it is used."""

import ast
from importlib import import_module
from pathlib import Path
import subprocess
import sys

import pytest
import sph_stab_ros

SOURCE = Path(sph_stab_ros.__file__)


def typed_imports():
    """Return name -> module of the imports that type checkers see."""
    for node in ast.parse(SOURCE.read_text()).body:
        if isinstance(node, ast.If) and getattr(node.test, 'id', '') == 'TYPE_CHECKING':
            return {alias.name: one.module for one in node.body for alias in one.names}
    raise AssertionError('there are no imports for type checkers')


def test_type_checkers_see_what_is_public():
    assert sorted(typed_imports()) == sorted(sph_stab_ros.__all__)
    assert len(set(sph_stab_ros.__all__)) == len(sph_stab_ros.__all__)
    assert set(sph_stab_ros.__all__) <= set(dir(sph_stab_ros))


@pytest.mark.parametrize('name', sph_stab_ros.__all__)
def test_a_public_name_is_what_type_checkers_see(name):
    module = import_module(typed_imports()[name])
    assert getattr(sph_stab_ros, name) is getattr(module, name)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match='no_such_name'):
        sph_stab_ros.no_such_name
    with pytest.raises(ImportError):
        from sph_stab_ros import no_such_name  # noqa: F401


def test_importing_the_package_imports_nothing_else():
    code = ('import sys, sph_stab_ros.executable; '
            'print(*{"numpy", "scipy", "cv2", "rosbags"} & {*sys.modules}); '
            'from sph_stab_ros import StabilizerConfig; '
            'print(*{"cv2", "rosbags"} & {*sys.modules})')
    done = subprocess.run([sys.executable, '-c', code], cwd=SOURCE.parents[1], text=True,
                          capture_output=True, timeout=60, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize('module', ['replay', 'stabilizer', 'ros.node'])
def test_what_only_an_evaluation_needs_costs_no_start(module):
    """Statistics, optimisers and filters of SciPy took two fifths of the CPU of a start."""
    pytest.importorskip('rclpy')
    code = (f'import sys, sph_stab_ros.{module}; print(*{{"scipy.stats", "scipy.optimize", '
            '"scipy.signal", "scipy.ndimage", "matplotlib"} & {*sys.modules})')
    done = subprocess.run([sys.executable, '-c', code], cwd=SOURCE.parents[1], text=True,
                          capture_output=True, timeout=60, check=True)
    assert done.stdout.split() == []
