# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Set a process up for large pictures and thin matrices, and end it in bounded time."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import ctypes
import logging
import signal
from typing import Any

# glibc's names for what mallopt sets, and the largest threshold that it takes.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
MAX_MMAP_THRESHOLD = 32 << 20
NEVER = 1 << 30
ENDING_S = 10


def set_up_process() -> None:
    """Limit BLAS's threads and keep freed memory; before others start threads."""
    limit_blas_threads()
    keep_freed_memory()


def limit_blas_threads() -> None:
    """
    Let BLAS use one thread.

    The matrices here are long and thin: a second thread waits more than it multiplies, 0.13 s of
    CPU per frame against 0.03 s on two busy cores.
    """
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        logging.getLogger(__name__).debug('threadpoolctl is not there, BLAS keeps its threads')
    else:
        threadpool_limits(1, user_api='blas')


def keep_freed_memory() -> None:
    """
    Let the memory of one picture be that of the next.

    glibc gives large pieces back to the system, which clears every page before it is used again:
    receiving a raw image of 5.5 MB through rclpy took 17 ms of CPU that way, and takes 5 ms.
    """
    mallopt = _in_glibc('mallopt')
    if mallopt:
        mallopt(M_MMAP_THRESHOLD, MAX_MMAP_THRESHOLD)
        mallopt(M_TRIM_THRESHOLD, NEVER)
        # Each thread's arena would keep some of its own.
        mallopt(M_ARENA_MAX, 1)


def give_back_freed_memory() -> None:
    """Give the system what has been kept; now and then, so that it does not pile up."""
    malloc_trim = _in_glibc('malloc_trim')
    if malloc_trim:
        malloc_trim(0)


@contextmanager
def bounded_ending() -> Iterator[None]:
    """
    Let the system end the process where the block takes longer than ENDING_S.

    Fast DDS may spin for minutes when it destroys a participant while others leave, as after a
    Ctrl-C that they all get (github.com/eProsima/Fast-DDS/issues/6513). It keeps the interpreter
    meanwhile: nothing but the system can act.
    """
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(ENDING_S)
    try:
        yield
    finally:
        signal.alarm(0)


def _in_glibc(name: str) -> Callable[..., Any] | None:
    """Return a function of the C library's, None where it is another one."""
    try:
        return getattr(ctypes.CDLL(None), name, None)
    except (OSError, TypeError):
        return None
