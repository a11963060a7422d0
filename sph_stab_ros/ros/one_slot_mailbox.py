# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The way from the executor's thread to the worker's: only the newest message counts."""

from threading import Condition
from typing import Generic, TypeVar

Item = TypeVar('Item')


class OneSlotMailbox(Generic[Item]):
    """
    Holds one item for another thread; a newer one takes the place of one not yet fetched.

    ``dropped`` counts those that were replaced.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._condition = Condition()
        self._item: Item | None = None
        self._closed = False

    def put(self, item: Item) -> None:
        """Leave an item, not None, for the other thread."""
        with self._condition:
            self.dropped += self._item is not None
            self._item = item
            self._condition.notify()

    def get(self) -> Item | None:
        """Wait for an item and return it; None once the mailbox is closed."""
        with self._condition:
            self._condition.wait_for(lambda: self._item is not None or self._closed)
            item, self._item = self._item, None
            return None if self._closed else item

    def close(self) -> None:
        """Let the other thread go, whether there is an item or not."""
        with self._condition:
            self._closed = True
            self._condition.notify()
