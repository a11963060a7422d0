# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Jazzy's linters, with their own rules: flake8, pep257 and, where installed, the rest."""

import ast
from pathlib import Path
import shutil
import subprocess
import sys

from ament_pep257.main import main as pep257
from mccabe import PathGraphingAstVisitor
import pytest

ROOT = Path(__file__).resolve().parents[1]
# As many ways through a function; more than ten are command lines and containers of video.
MAX_COMPLEXITY = 13


@pytest.fixture(autouse=True)
def in_root(monkeypatch):
    monkeypatch.chdir(ROOT)


def python_paths():
    """Return what holds the project's Python; never a build tree beside it."""
    candidates = ('setup.py', 'sph_stab_ros', 'test', 'tools', 'launch', 'examples', 'docs')
    return [path for path in candidates if (ROOT / path).exists()]


def test_flake8():
    """In a process of its own: it forks, and children would wait for threads of FFmpeg here."""
    done = subprocess.run([sys.executable, '-m', 'ament_flake8.main', *python_paths()],
                          text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_no_function_is_too_complex():
    """T. J. McCabe's cyclomatic complexity, as flake8 counts it."""
    complex_ones = []
    for folder in python_paths():
        for path in sorted((ROOT / folder).rglob('*.py')) or (ROOT / folder,):
            visitor = PathGraphingAstVisitor()
            visitor.preorder(ast.parse(path.read_text()), visitor)
            complex_ones += [f'{path}: {graph.entity}' for graph in visitor.graphs.values()
                             if graph.complexity() > MAX_COMPLEXITY]
    assert not complex_ones


def test_pep257(capsys, caplog):
    caplog.set_level('WARNING', 'pydocstyle.utils')
    status = pep257(argv=python_paths())
    assert status == 0, capsys.readouterr().err


def test_copyright(capsys):
    ament_copyright = pytest.importorskip(
        'ament_copyright.main', reason='ament_copyright comes with a ROS installation only')
    status = ament_copyright.main(argv=[*python_paths(), 'LICENSE'])
    assert status == 0, capsys.readouterr().err


def test_xmllint(capsys):
    ament_xmllint = pytest.importorskip(
        'ament_xmllint.main', reason='ament_xmllint comes with a ROS installation only')
    if shutil.which('xmllint') is None:
        pytest.skip('xmllint is not installed (libxml2-utils)')
    status = ament_xmllint.main(argv=['package.xml'])
    errors = capsys.readouterr().err
    if 'Failed to locate the main schema' in errors:
        pytest.skip('the schema of package.xml cannot be reached')
    assert status == 0, errors
