# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A Ctrl-C while a command still imports what it needs ends it without a traceback."""

from pathlib import Path
import subprocess
import sys

import pytest
from sph_stab_ros.__main__ import COMMANDS
from sph_stab_ros.executable import UNTIL_INTERRUPTED

ROOT = Path(__file__).resolve().parents[2]
# Stands in the way of what takes long to import, and is interrupted there.
NUMPY = """import signal
signal.raise_signal(signal.SIGINT)
raise AssertionError('nobody heard it')
"""
# As it is installed, behind the one name, and as a module.
CALLS = [(name, call) for name, (module, _) in COMMANDS.items() for call in (
    ('-c', f'from sph_stab_ros.executable import {name}; raise SystemExit({name}())'),
    ('-m', 'sph_stab_ros', name),
    ('-m', f"sph_stab_ros.{module.removesuffix('.__main__')}"))]


@pytest.mark.parametrize('name, call', CALLS)
def test_nothing_but_a_line_is_seen_of_what_was_imported(name, call, tmp_path):
    (tmp_path / 'numpy.py').write_text(NUMPY)
    done = subprocess.run([sys.executable, *call], cwd=tmp_path, text=True, capture_output=True,
                          timeout=60, env={'PYTHONPATH': str(ROOT)})
    expected = (0, '') if name in UNTIL_INTERRUPTED else (1, f'{name}: interrupted\n')
    assert (done.returncode, done.stderr) == expected
