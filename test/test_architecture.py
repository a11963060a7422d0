# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The order of the house: rooms that import one way, nothing at the top that cannot be run."""

import ast
import importlib
from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / 'sph_stab_ros'
MAX_LINES = 300
MAX_STATEMENTS = 40
SOURCES = sorted(path.relative_to(ROOT)
                 for folder in ('sph_stab_ros', 'tools', 'launch', 'examples')
                 for path in (ROOT / folder).rglob('*')
                 if path.suffix in ('.py', '.js', '.sh'))
PYTHON = [path for path in SOURCES if path.suffix == '.py']
FUNCTIONS = ast.FunctionDef, ast.AsyncFunctionDef


def nodes(path, *kinds):
    """Return the nodes of such kinds in a file of Python."""
    return [node for node in ast.walk(ast.parse((ROOT / path).read_text()))
            if isinstance(node, kinds)]


def of_self(attribute):
    """Tell whether an ast.Attribute is an object's own."""
    return isinstance(attribute.value, ast.Name) and attribute.value.id in ('self', 'cls')


def test_imports_go_one_way():
    """The contracts of pyproject.toml hold, inside functions too."""
    pytest.importorskip('importlinter', reason='import-linter is not installed')
    checked = subprocess.run(
        [sys.executable, '-c', 'from importlinter.cli import lint_imports_command; '
         'lint_imports_command()', '--no-cache'],
        cwd=ROOT, text=True, capture_output=True, timeout=120)
    assert checked.returncode == 0, checked.stdout + checked.stderr


@pytest.mark.parametrize('path', [
    path for path in PACKAGE.glob('*.py') if path.stem != '__init__'], ids=lambda path: path.stem)
def test_what_stands_at_the_top_can_be_run(path):
    assert "if __name__ == '__main__':" in path.read_text()
    pytest.importorskip('rclpy', reason='rclpy is not installed')
    assert callable(importlib.import_module(f'sph_stab_ros.{path.stem}').main)


@pytest.mark.parametrize('path', SOURCES, ids=str)
def test_a_file_can_be_read_at_once(path):
    lines = len((ROOT / path).read_text().splitlines())
    assert lines <= MAX_LINES, f'{lines} lines'


@pytest.mark.parametrize('path', PYTHON, ids=str)
def test_a_function_can_be_read_at_once(path):
    for function in nodes(path, *FUNCTIONS):
        statements = sum(isinstance(one, ast.stmt) for one in ast.walk(function)) - (
            2 if ast.get_docstring(function) else 1)
        assert statements <= MAX_STATEMENTS, f'{function.name}: {statements} statements'


def test_what_is_private_is_touched_by_its_owner_alone():
    """Of what this package's own classes and modules call private."""
    private = {node.name for path in PYTHON for node in nodes(path, *FUNCTIONS, ast.ClassDef)}
    private |= {node.attr for path in PYTHON for node in nodes(path, ast.Attribute)
                if of_self(node)}
    private = {name for name in private if name.startswith('_') and not name.endswith('__')}
    assert len(private) > 100
    for path in (*PYTHON, *(path.relative_to(ROOT) for path in (ROOT / 'test/tracking').iterdir()
                            if path.suffix == '.py')):
        touched = {node.attr for node in nodes(path, ast.Attribute) if not of_self(node)} | {
            one.name for node in nodes(path, ast.ImportFrom) for one in node.names}
        assert not touched & private, f'{path} touches {touched & private}'


def test_each_room_says_what_it_is_for():
    for folder in (PACKAGE, *(path for path in PACKAGE.rglob('*') if path.is_dir())):
        if any(folder.glob('*.py')):
            module = (folder / '__init__.py').read_text()
            assert '"""' in module, f'{folder.relative_to(ROOT)} has no docstring'
