# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The way from the executor's thread to a worker's: the newest messages count."""

from collections import deque
from threading import Condition
from typing import Generic, TypeVar

Item = TypeVar('Item')


class Mailbox(Generic[Item]):
    """
    Holds the newest item for another thread, or as many as ``size`` in their order.

    Where it is full all that have not been fetched give way to the next one; ``dropped`` counts
    them.
    """

    def __init__(self, size: int = 1) -> None:
        self.dropped = 0
        self._size = size
        self._condition = Condition()
        self._items: deque[Item] = deque()
        self._closed = False

    def put(self, item: Item) -> None:
        """Leave an item for the other thread."""
        with self._condition:
            if len(self._items) == self._size:
                self.dropped += self._size
                self._items.clear()
            self._items.append(item)
            self._condition.notify()

    def get(self) -> Item | None:
        """Wait for an item and return it; None once the mailbox is closed."""
        with self._condition:
            self._condition.wait_for(lambda: self._items or self._closed)
            return None if self._closed else self._items.popleft()

    def close(self) -> None:
        """Let the other thread go, whether there is an item or not."""
        with self._condition:
            self._closed = True
            self._condition.notify()
