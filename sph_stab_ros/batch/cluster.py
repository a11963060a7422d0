# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tasks on the workers of a Dask cluster, which see the same files under the same paths."""

from collections.abc import Generator, Sequence
from dataclasses import asdict
from functools import partial
import logging
from queue import SimpleQueue
from typing import Any, TYPE_CHECKING
from uuid import uuid4

from sph_stab_ros.batch.tasks import Again, Event, Outcome, Processes, Progress, run_task, Task
from sph_stab_ros.recording import RecordingError

if TYPE_CHECKING:
    from distributed import Future

CONNECTING_S = 15


def run_on_cluster(tasks: Sequence[Task], address: str) -> Generator[Event, None, None]:
    """
    Yield what happens to the tasks until all have ended; closed early, it cancels them.

    What a lost worker was doing another one begins anew; its own process ends by itself, when
    nobody reads its progress or its folder is gone.
    """
    try:
        from distributed import Client
    except ImportError:
        raise RecordingError(
            "--scheduler needs Dask: pip install 'sph_stab_ros[cluster]'") from None
    # What it says of connections that come and go is no concern of the user's.
    for name in ('distributed', 'distributed.client'):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    events: SimpleQueue[Event] = SimpleQueue()
    topic = f'sph_stab_ros-{uuid4().hex}'
    try:
        client = Client(address, timeout=CONNECTING_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise RecordingError(f'no Dask scheduler answers at {address}: {error}') from None
    with client:
        client.subscribe_topic(topic, lambda event: events.put(_said(*event[1])))
        # The names are for the scheduler's own page.
        futures = [client.submit(run_on_worker, task, topic, key=f'{task.name}-{uuid4().hex}',
                                 pure=False) for task in tasks]
        try:
            for future, task in zip(futures, tasks, strict=True):
                future.add_done_callback(partial(_ended, events=events, task=task))
            left = len(tasks)
            while left:
                event = events.get()
                left -= isinstance(event, Outcome)
                yield event
        finally:
            client.cancel([future for future in futures if not future.done()])


def run_on_worker(task: Task, topic: str) -> Outcome:
    """Do a task on the worker of the cluster that this is called on."""
    from distributed import get_worker
    worker = get_worker()

    def say(event: Progress | Again) -> None:
        # In a list: to a dictionary Dask would add something.
        worker.log_event(topic, [asdict(event)])
    return run_task(task, say, Processes())


def _said(event: dict[str, Any]) -> Event:
    return Progress(**event) if 'frames' in event else Again(**event)


def _ended(future: 'Future', events: 'SimpleQueue[Event]', task: Task) -> None:
    """Note the end of a task, whatever it was."""
    if future.cancelled():
        outcome = Outcome(task.name, 'the cluster has lost it', failed=True)
    elif (error := future.exception()) is not None:
        outcome = Outcome(task.name, f'{type(error).__name__}: {str(error).splitlines()[0]}',
                          failed=True)
    else:
        outcome = future.result()
    events.put(outcome)
