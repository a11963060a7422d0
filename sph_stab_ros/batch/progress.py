# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One line for each recording that is worked on, and one over all; shown on terminals only."""

from types import TracebackType

from sph_stab_ros.batch.tasks import Again, Event, Outcome, Progress

from tqdm import tqdm


class ProgressLines:
    """What is shown while tasks run; a context manager."""

    def __init__(self, tasks: int) -> None:
        self._all = tqdm(total=tasks, unit=' recordings', disable=None, position=0)
        self._of: dict[str, tqdm] = {}

    def __enter__(self) -> 'ProgressLines':
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        for line in (*self._of.values(), self._all):
            line.close()

    def show(self, event: Event) -> None:
        """Show an Event; how a task has ended is printed, on a terminal or not."""
        if isinstance(event, Progress):
            line = self._of.get(event.name)
            if line is None:
                line = self._of[event.name] = tqdm(
                    desc=event.name, total=event.total, unit=' frames', disable=None,
                    leave=False)
            line.update(event.frames - line.n)
            return
        line = self._of.pop(event.name, None)
        if line is not None:
            line.close()
        if isinstance(event, Again):
            tqdm.write(f'{event.name}: {event.reason}; it begins again')
        elif isinstance(event, Outcome):
            tqdm.write(f'{event.name}: {"failed: " if event.failed else ""}{event.line}')
            self._all.update()
