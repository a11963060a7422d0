# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Run the package's executables as processes and measure what they use (Linux)."""

from collections.abc import Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import signal
import subprocess
import sys
from typing import Any

ENDING_S = 30.
CLOCK_TICKS_PER_S = os.sysconf('SC_CLK_TCK')


@contextmanager
def running(module: str, *args: str) -> Iterator[subprocess.Popen[Any]]:
    """
    Run an executable of the package until the block ends; give its Popen.

    It is asked to end by SIGINT, as Ctrl-C does, and killed when it does not.
    """
    # Not its entry point: this also works where the package is not installed.
    process = subprocess.Popen((sys.executable, '-m', f'sph_stab_ros.{module}', *args))
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(ENDING_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def cpu_s(pid: int) -> float:
    """Return the CPU time in seconds that a process has used so far, all threads together."""
    # The name, in parentheses, may hold anything; user and system time are fields 14 and 15.
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / CLOCK_TICKS_PER_S


def memory_mb(pid: int) -> dict[str, float]:
    """
    Return by name what memory a process holds, in MB.

    ``rss`` is all that is resident, shared memory of the middleware and libraries included;
    ``private`` only what no other process could account for.
    """
    held_mb = {}
    for line in Path(f'/proc/{pid}/smaps_rollup').read_text().splitlines()[1:]:
        name, amount = line.split()[:2]
        # In units of 1024 bytes, though they are called kB.
        held_mb[name.rstrip(':')] = int(amount) * 1024 / 1e6
    return {'rss': held_mb['Rss'], 'private': held_mb['Private_Clean'] + held_mb['Private_Dirty']}
