# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One recording to stabilise, and a process of its own that does it."""

from argparse import Namespace
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
import json
from pathlib import Path
import pickle
import shutil
import signal
import subprocess
import sys
from tempfile import TemporaryFile
from threading import Lock
from typing import Any, IO, TypeAlias
from uuid import uuid4

from sph_stab_ros.batch.results import Identity, PARTIAL, SEGMENTS
from sph_stab_ros.config import Settings
from sph_stab_ros.recording.base import Stretch

# Of a process that was killed, which another one may do without.
RETRIES = 2


@dataclass(frozen=True)
class Task:
    """
    What a process needs to know, wherever it runs: all paths are absolute.

    ``args`` and ``settings`` are those of ``replay``; ``video`` says whether there is one or a bag
    (None: neither), ``evaluate`` whether the trajectory is compared with truth, ``track`` whether
    there is anything else to do. ``stretch`` is that of a segment, which is tracked and no more;
    ``segments`` are the results of those that are to be joined.
    """

    name: str
    recording: Path
    out: Path
    identity: Identity
    args: Namespace
    settings: Settings
    video: bool | None
    evaluate: bool
    track: bool
    memory_mb: int
    cores: frozenset[int] = frozenset()
    attempt: str = ''
    stretch: Stretch | None = None
    segments: tuple[Path, ...] = ()

    @property
    def result(self) -> Path:
        """Return the folder of what is whole."""
        return self.out / (SEGMENTS if self.stretch else '') / self.name

    @property
    def partial(self) -> Path:
        """Return the folder of what is not whole yet."""
        return self.out / PARTIAL / self.attempt


@dataclass(frozen=True)
class Progress:
    """So many frames are done, of so many if that is known."""

    name: str
    frames: int
    total: int | None


@dataclass(frozen=True)
class Again:
    """A process was lost, and another one begins from the start."""

    name: str
    reason: str


@dataclass(frozen=True)
class Outcome:
    """
    The end of a task: a line that tells of the result, or the reason why there is none.

    A failure is ``lasting`` where the recording itself is the reason.
    """

    name: str
    line: str
    failed: bool = False
    lasting: bool = False


Event: TypeAlias = Progress | Again | Outcome
Say: TypeAlias = Callable[[Progress | Again], Any]


class Processes:
    """Those that run, to be ended all at once."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._running: set[subprocess.Popen[str]] = set()
        self.ended = False

    def start(self, errors: IO[str]) -> subprocess.Popen[str] | None:
        """Return a process that waits for its task, None where no more are wanted."""
        with self._lock:
            if self.ended:
                return None
            # Out of the reach of a Ctrl-C, which is for whoever started it to answer.
            process = subprocess.Popen(
                [sys.executable, '-m', 'sph_stab_ros.batch.worker'], stdin=subprocess.PIPE,
                stdout=subprocess.PIPE, stderr=errors, text=True, start_new_session=True)
            self._running.add(process)
            return process

    def forget(self, process: subprocess.Popen[str]) -> None:
        """Leave out one that has ended."""
        with self._lock:
            self._running.discard(process)

    def end(self) -> None:
        """Kill them all, and start no more."""
        with self._lock:
            self.ended = True
            for process in self._running:
                process.kill()


def run_task(task: Task, say: Say, processes: Processes) -> Outcome:
    """Do a task in a process, in another one where that is killed; return its Outcome."""
    reason = ''
    for attempt in range(1 + RETRIES):
        if attempt:
            say(Again(task.name, reason))
        task = replace(task, attempt=uuid4().hex)
        task.partial.mkdir(parents=True)
        try:
            outcome, reason = _run_once(task, say, processes)
            # Where the folder is gone nobody waits for the result any more.
            if outcome is not None or processes.ended or not task.partial.is_dir():
                return outcome or Outcome(task.name, reason, failed=True)
        finally:
            shutil.rmtree(task.partial, ignore_errors=True)
    return Outcome(task.name, f'{reason}, {1 + RETRIES} times', failed=True)


def _run_once(task: Task, say: Say, processes: Processes) -> tuple[Outcome | None, str]:
    """Return the Outcome, or None and the reason where the process was killed."""
    # Not a pipe, which would fill up: libraries may say a lot.
    with TemporaryFile('w+', errors='replace') as errors:
        process = processes.start(errors)
        if process is None:
            return None, 'interrupted'
        last = None
        try:
            assert process.stdin and process.stdout
            # It may not live to read it, which its status tells.
            with suppress(BrokenPipeError):
                process.stdin.write(pickle.dumps(task).hex())
                process.stdin.close()
            for line in process.stdout:
                said: dict[str, Any] = json.loads(line)
                if 'frames' in said:
                    say(Progress(task.name, **said))
                else:
                    last = said
            status = process.wait()
        finally:
            process.kill()
            process.wait()
            processes.forget(process)
        if last is not None:
            return Outcome(task.name, **last), ''
        if status < 0:
            return None, f'its process was ended by {signal.Signals(-status).name}'
        errors.seek(0)
        lines = errors.read().strip().splitlines()
        return Outcome(task.name, lines[-1] if lines else f'its process ended with {status}',
                       failed=True), ''
