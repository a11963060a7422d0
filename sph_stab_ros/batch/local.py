# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tasks on this machine, a process for each, as many at once as there are cores or memory for."""

from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
import os
from queue import SimpleQueue
import random

from sph_stab_ros.batch.tasks import Event, Outcome, Processes, run_task, Task


def allowed_cores() -> set[int]:
    """Return the cores that this process may use."""
    if hasattr(os, 'sched_getaffinity'):
        return os.sched_getaffinity(0)
    return set(range(os.cpu_count() or 1))


def most_jobs(memory_mb: int) -> int:
    """Return how many processes there are cores and free memory for, at least one."""
    return max(1, min(len(allowed_cores()), free_memory_mb() // memory_mb))


def free_memory_mb() -> int:
    """Return how much memory can be had without swapping."""
    try:
        return os.sysconf('SC_AVPHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') // 2**20
    except (OSError, ValueError):
        return 2**20


def run_here(tasks: Sequence[Task], jobs: int) -> Generator[Event, None, None]:
    """Yield what happens to the tasks until all have ended; closed early, it ends them."""
    events: SimpleQueue[Event] = SimpleQueue()
    processes = Processes()
    cores = allowed_cores()
    # Libraries start threads of their own: together they get no more cores than there are jobs.
    # At random, so that two batches do not choose the same.
    chosen = frozenset(random.sample(sorted(cores), min(jobs, len(cores))))

    def work(task: Task) -> None:
        try:
            events.put(run_task(replace(task, cores=chosen), events.put, processes))
        except Exception as error:
            # Whatever it is, who waits for the end of the task must be told.
            events.put(Outcome(task.name, f'{type(error).__name__}: {error}', failed=True))

    pool = ThreadPoolExecutor(jobs)
    try:
        for task in tasks:
            pool.submit(work, task)
        left = len(tasks)
        while left:
            event = events.get()
            left -= isinstance(event, Outcome)
            yield event
    finally:
        processes.end()
        pool.shutdown(cancel_futures=True)
