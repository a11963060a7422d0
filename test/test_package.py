# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The package as a whole: its metadata agree, its core needs no ROS, colcon builds what runs."""

import ast
import importlib
import os
from pathlib import Path
import re
import runpy
import shutil
import signal
import subprocess
import sys
import threading
from unittest import mock
from xml.etree import ElementTree

import pytest
import sph_stab_ros
from sph_stab_ros import executable
from sph_stab_ros.__main__ import COMMANDS
from sph_stab_ros.stabilization.outputs import topics

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = 'sph_stab_ros'

# Modules from outside of ROS: the name on the package index and rosdep's key. rosdep has no key
# for PyAV, and what rosbags itself needs comes with rosbags.
PYTHON_DEPENDENCIES = {
    'aiohttp': ('aiohttp', 'python3-aiohttp'),
    'aioquic': ('aioquic', None),
    'av': ('av', None),
    'backports': ('backports.zstd', None),
    'cryptography': ('cryptography', 'python3-cryptography'),
    'cv2': ('opencv-python-headless', 'python3-opencv'),
    'distributed': ('distributed', None),
    'lz4': ('lz4', None),
    'matplotlib': ('matplotlib', 'python3-matplotlib'),
    'numpy': ('numpy', 'python3-numpy'),
    'poselib': ('poselib', None),
    'pycolmap': ('pycolmap', None),
    'rosbags': ('rosbags', 'python3-rosbags-pip'),
    'ruamel': ('ruamel.yaml', None),
    'scipy': ('scipy', 'python3-scipy'),
    'threadpoolctl': ('threadpoolctl', None),
    'tqdm': ('tqdm', 'python3-tqdm'),
}
OPTIONAL_MODULES = {
    'aioquic', 'av', 'distributed', 'matplotlib', 'poselib', 'pycolmap', 'threadpoolctl'}
# The only modules, and with `ros` all modules below it, that may need ROS to be imported.
ROS_MODULES = tuple(f'{PACKAGE}.{name}' for name in (
    'benchmark.node', 'benchmark.soak', 'benchmark.source', 'camera', 'demo',
    'operator.__main__', 'operator.robot', 'player', 'ros', 'stabilizer'))


@pytest.fixture
def setup_arguments(monkeypatch):
    monkeypatch.chdir(ROOT)
    with mock.patch('setuptools.setup') as setup:
        runpy.run_path('setup.py')
    return setup.call_args.kwargs


@pytest.fixture
def manifest():
    return ElementTree.parse(ROOT / 'package.xml').getroot()


def imported_modules():
    """Return the top-level names that the package and its launch files import, however late."""
    names = set()
    for directory in (PACKAGE, 'launch'):
        for path in (ROOT / directory).rglob('*.py'):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Import):
                    names.update(alias.name.partition('.')[0] for alias in node.names)
                elif isinstance(node, ast.ImportFrom):
                    names.add(node.module.partition('.')[0])
    return names - set(sys.stdlib_module_names) - {PACKAGE, 'compression'}


def package_modules():
    """Return the full names of all modules of the package."""
    paths = (path.relative_to(ROOT).with_suffix('') for path in (ROOT / PACKAGE).rglob('*.py'))
    return {'.'.join(path.parts).removesuffix('.__init__') for path in paths}


def console_scripts(setup_arguments):
    """Return name -> 'module:function' of the executables that setup.py declares."""
    return dict(script.replace(' ', '').split('=')
                for script in setup_arguments['entry_points']['console_scripts'])


def test_manifest_and_setup_agree(setup_arguments, manifest):
    for key in ('name', 'version', 'license'):
        assert manifest.findtext(key) == setup_arguments[key]
    assert manifest.find('license').get('file') == 'LICENSE'
    assert manifest.findtext('export/build_type') == 'ament_python'


def test_one_version_is_named_everywhere(manifest):
    version = manifest.findtext('version')
    assert sph_stab_ros.__version__ == version
    assert f'\nversion: {version}\n' in (ROOT / 'CITATION.cff').read_text()


def test_setup_requires_what_is_imported(setup_arguments):
    extras = setup_arguments['extras_require']
    requirements = [*setup_arguments['install_requires'],
                    *(extra for name in (
                        'cluster', 'datagrams', 'operator', 'plots', 'references', 'video')
                      for extra in extras[name])]
    required = {re.match(r'[\w.-]+', requirement).group() for requirement in requirements}
    # What aioquic needs itself.
    required.remove('pyopenssl')
    used = imported_modules() & PYTHON_DEPENDENCIES.keys()
    assert required == {PYTHON_DEPENDENCIES[module][0] for module in used}


def test_manifest_depends_on_what_is_imported(manifest):
    depends = {element.text for element in manifest.findall('exec_depend')}
    # Types of messages are imported by their names.
    published = {msgtype.split('/')[0] for msgtype in topics(['view']).values()}
    used = imported_modules() | published
    keys = {PYTHON_DEPENDENCIES[module][1] for module in used & PYTHON_DEPENDENCIES.keys()}
    assert depends == (keys - {None}) | (used - PYTHON_DEPENDENCIES.keys())


def test_executables_are_importable(setup_arguments):
    pytest.importorskip('rclpy', reason='rclpy is not installed')
    for target in console_scripts(setup_arguments).values():
        module, function = target.split(':')
        assert callable(getattr(importlib.import_module(module), function))
    for name, (module, _) in COMMANDS.items():
        assert getattr(executable, name).args == (module,)
        assert callable(importlib.import_module(f'{PACKAGE}.{module}').main)


def test_all_executables_are_behind_one_name(setup_arguments):
    commands = {name: f'{PACKAGE}.executable:{name}' for name in COMMANDS}
    assert {**commands, 'sph-stab': f'{PACKAGE}.__main__:main'} == console_scripts(setup_arguments)


@pytest.mark.parametrize('arguments, status, start', [
    (['replay', '--help'], 0, 'usage: replay '), (['replay', 'nowhere'], 1, 'replay: nowhere '),
    (['--help'], 0, 'usage: sph-stab NAME '), ([], 2, 'usage: sph-stab NAME '),
    (['dance'], 2, 'usage: sph-stab NAME ')])
def test_the_one_name_runs_what_it_is_told(arguments, status, start):
    done = subprocess.run([sys.executable, '-m', PACKAGE, *arguments], cwd=ROOT, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=60)
    assert done.returncode == status and done.stdout.startswith(start)


def test_core_imports_without_ros():
    blocked = imported_modules() - PYTHON_DEPENDENCIES.keys() | {'rclpy'}
    core = [module for module in package_modules() if not module.startswith(ROS_MODULES)]
    code = (f'import importlib, sys; sys.modules.update(dict.fromkeys({sorted(blocked)}));'
            f'list(map(importlib.import_module, {sorted(core)}))')
    subprocess.run([sys.executable, '-c', code], cwd=ROOT, check=True, timeout=60)


def test_replay_of_bags_needs_no_optional_module():
    code = (f'import sys; sys.modules.update(dict.fromkeys({sorted(OPTIONAL_MODULES)}));'
            f'import {PACKAGE}.replay')
    subprocess.run([sys.executable, '-c', code], cwd=ROOT, check=True, timeout=60)


# Finds none of the modules named before the program, then runs it as __main__.
WITHOUT_MODULES = """
import runpy
import sys


class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] in missing:
            raise ModuleNotFoundError(f'{name} is blocked', name=name)


missing, program = sys.argv[1].split(','), sys.argv[2]
del sys.argv[:2]
sys.meta_path.insert(0, Missing())
runpy.run_module(program, run_name='__main__', alter_sys=True)
"""
# Of recordings, tables, plots and the page.
NOT_FOR_THE_NODE = {
    'aiohttp', 'av', 'cryptography', 'lz4', 'matplotlib', 'rosbags', 'ruamel', 'tqdm'}


def without_modules(missing, program, *arguments):
    """Start a program of the package's where modules are not installed."""
    # Alone in its domain, out of the way of a robot's nodes.
    return subprocess.Popen(
        [sys.executable, '-c', WITHOUT_MODULES, ','.join(missing), f'{PACKAGE}.{program}',
         *arguments], cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        env={**os.environ, 'ROS_DOMAIN_ID': str(1 + os.getpid() % 100)})


def test_the_node_starts_without_what_only_others_need():
    pytest.importorskip('rclpy', reason='rclpy is not installed')
    process = without_modules(NOT_FOR_THE_NODE, 'stabilizer')
    killer = threading.Timer(60, process.kill)
    killer.start()
    first_line = process.stdout.readline()
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate()
    killer.cancel()
    assert process.returncode == 0, first_line + output
    assert '[stabilizer]' in first_line


@pytest.mark.parametrize('program', ['operator', 'player'])
def test_what_is_missing_is_missed_by_those_who_ask_for_it(program):
    pytest.importorskip('rclpy', reason='rclpy is not installed')
    output, _ = without_modules(NOT_FOR_THE_NODE, program, '--help').communicate(timeout=60)
    assert output.startswith('usage: ')


def find_colcon():
    """Return the path of colcon, of this very Python if it has one, or None."""
    beside_python = Path(sys.executable).with_name('colcon')
    return str(beside_python) if beside_python.exists() else shutil.which('colcon')


@pytest.fixture(scope='module', params=[
    'copied', pytest.param('symlinked', marks=pytest.mark.slow)])
def workspace(request, tmp_path_factory):
    """Build a copy of the package with colcon and return the workspace."""
    colcon = find_colcon()
    if colcon is None:
        pytest.skip('colcon is not installed')
    directory = tmp_path_factory.mktemp(request.param)
    shutil.copytree(ROOT, directory / 'src' / PACKAGE, ignore=shutil.ignore_patterns(
        '.*', '*.egg-info', '__pycache__', 'bags', 'build', 'install', 'log', 'results'))
    option = ['--symlink-install'] if request.param == 'symlinked' else []
    built = subprocess.run([colcon, 'build', *option], cwd=directory, timeout=120, text=True,
                           stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    assert built.returncode == 0, built.stdout
    return directory


def in_workspace(workspace, command, **options):
    """Start a command, a string, in the sourced workspace as a user does."""
    shell = ['sh', '-c', f'. install/local_setup.sh && exec {command}']
    return subprocess.Popen(shell, cwd=workspace, text=True, stdout=subprocess.PIPE,
                            stderr=subprocess.STDOUT, **options)


def test_colcon_installs_everything(workspace, setup_arguments):
    executables = workspace / f'install/{PACKAGE}/lib/{PACKAGE}'
    assert {path.name for path in executables.iterdir()} == set(console_scripts(setup_arguments))
    share = workspace / f'install/{PACKAGE}/share/{PACKAGE}'
    for directory in ('config', 'launch'):
        in_source = {path.name for path in (ROOT / directory).glob('*.*')}
        assert {path.name for path in (share / directory).iterdir()} == in_source
    command = f'{sys.executable} -c "import {PACKAGE}; print({PACKAGE}.__file__)"'
    output, _ = in_workspace(workspace, command).communicate(timeout=60)
    assert output.startswith(str(workspace))


def test_colcon_installs_the_page(workspace):
    pytest.importorskip('aiohttp', reason='aiohttp is not installed')
    code = f'from {PACKAGE}.operator.page_files import page_files; print(*sorted(page_files()))'
    output, _ = in_workspace(workspace, f'{sys.executable} -c "{code}"').communicate(timeout=60)
    in_source = sorted(path.name for path in (ROOT / PACKAGE / 'operator' / 'page').iterdir())
    assert output.split() == in_source


def test_colcon_installs_a_replay_that_runs(workspace):
    process = in_workspace(workspace, f'install/{PACKAGE}/lib/{PACKAGE}/replay --help')
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0, output
    assert '--trajectory' in output


@pytest.mark.ros
def test_colcon_installs_a_node_that_runs(workspace):
    pytest.importorskip('rclpy', reason='rclpy is not installed')
    # Alone in its domain, out of the way of a robot's nodes.
    environment = {**os.environ, 'ROS_DOMAIN_ID': str(1 + os.getpid() % 100)}
    process = in_workspace(workspace, f'install/{PACKAGE}/lib/{PACKAGE}/stabilizer',
                           env=environment)
    killer = threading.Timer(60, process.kill)
    killer.start()
    first_line = process.stdout.readline()
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate()
    killer.cancel()
    assert process.returncode == 0, first_line + output
    assert '[stabilizer]' in first_line
