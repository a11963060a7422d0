# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The hints say the truth about types: mypy finds nothing, by the rules in pyproject.toml."""

from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
# NumPy's hints, and what can be written in them, differ from one Python to the next.
PYTHON = (3, 11)


@pytest.mark.skipif(sys.version_info[:2] != PYTHON, reason='types are checked on 3.11 only')
@pytest.mark.skipif(np.__version__ < '2', reason='types are checked with NumPy 2 only')
def test_mypy():
    pytest.importorskip('mypy', reason='mypy is not installed')
    checked = subprocess.run(
        [sys.executable, '-m', 'mypy'], cwd=ROOT, text=True, capture_output=True, timeout=300)
    assert checked.returncode == 0, checked.stdout + checked.stderr
