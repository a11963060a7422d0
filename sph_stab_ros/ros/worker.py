# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A thread that works on the newest items; those it has no time for are dropped."""

from collections.abc import Callable
from threading import Thread
from typing import Any

from sph_stab_ros.ros.mailbox import Mailbox


class Worker:
    """
    Calls ``work(*item)`` in a thread of its own for the newest item put, or for the newest few.

    ``work`` must not raise anything. So many as ``waiting`` may wait for it, see Mailbox.
    """

    def __init__(self, name: str, work: Callable[..., None], waiting: int = 1) -> None:
        self._mailbox: Mailbox[tuple[Any, ...]] = Mailbox(waiting)
        self._work = work
        self._thread = Thread(target=self._run, name=name, daemon=True)

    @property
    def dropped(self) -> int:
        """Return how many items gave way to newer ones."""
        return self._mailbox.dropped

    def start(self) -> None:
        """Start to work."""
        self._thread.start()

    def put(self, *item: Any) -> None:
        """Leave something to be worked on, in place of what is not begun yet if that is full."""
        self._mailbox.put(item)

    def close(self) -> None:
        """Let the work at hand be finished, and wait for that."""
        self._mailbox.close()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while (item := self._mailbox.get()) is not None:
            self._work(*item)
