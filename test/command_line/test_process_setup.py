# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How a process is set up."""

from pathlib import Path
import signal
import subprocess
import sys

import pytest
from sph_stab_ros.command_line.process_setup import bounded_ending

ROOT = Path(__file__).resolve().parents[2]
# Whether memory is kept when twenty pictures are dropped, and what remains after it is given back.
PROGRAM = """
from sph_stab_ros.command_line.process_setup import give_back_freed_memory, set_up_process
from sph_stab_ros.command_line.processes import memory_mb
import os
set_up_process()
before = memory_mb(os.getpid())['private']
pictures = [bytearray(b'x' * 5_000_000) for _ in range(20)]
held = memory_mb(os.getpid())['private']
del pictures
kept = memory_mb(os.getpid())['private']
give_back_freed_memory()
after = memory_mb(os.getpid())['private']
print(held - before, kept - before, after - before)
"""


@pytest.mark.skipif(sys.platform != 'linux', reason='only glibc keeps and gives back by request')
def test_freed_memory_is_kept_until_it_is_given_back():
    result = subprocess.run([sys.executable, '-c', PROGRAM], cwd=ROOT, text=True,
                            capture_output=True, check=True, timeout=60)
    held, kept, after = map(float, result.stdout.split())
    assert held > 90 and kept > 90
    assert after < 20


def test_an_ending_that_hangs_is_ended():
    """Even with the interpreter in its hands, as Fast DDS has it."""
    program = ('import ctypes; from sph_stab_ros.command_line import process_setup; '
               'process_setup.ENDING_S = 1\n'
               'with process_setup.bounded_ending(): ctypes.PyDLL(None).sleep(60)')
    ended = subprocess.run([sys.executable, '-c', program], timeout=30)
    assert ended.returncode == -signal.SIGALRM


def test_an_ending_in_time_leaves_nothing_behind():
    with bounded_ending():
        pass
    assert signal.alarm(0) == 0
