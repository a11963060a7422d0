# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What is to be done of each recording, before anything is begun."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sph_stab_ros.batch.discovery import Found
from sph_stab_ros.batch.results import (
    EVALUATION, FAILURES, Identity, identity_of, MANIFEST, manifest_of, read_json, write_json)
from sph_stab_ros.batch.tasks import Outcome
from sph_stab_ros.command_line.columns import in_columns
from sph_stab_ros.recording import RecordingError

TO_DO, AGAIN, EVALUATE, DONE, FAILED = 'to do', 'again', 'evaluate', 'done', 'failed'
# What an Identity is made of, in words.
CHANGED = {'version': 'by another version', 'input': 'of another content',
           'options': 'with other options'}


@dataclass(frozen=True)
class Entry:
    """A recording, what is to be done of it, and why or with how many bytes."""

    found: Found
    state: str
    note: str = ''
    identity: Identity = field(default_factory=dict)
    # Of those that have failed, whether for good.
    lasting: bool = False

    @property
    def is_work(self) -> bool:
        """Tell whether a process is needed."""
        return self.state in (TO_DO, AGAIN, EVALUATE)


def make_plan(recordings: Sequence[Found], out: Path, options: Mapping[str, Any], *,
              evaluate: bool, force: bool, retry: bool) -> Iterator[Entry]:
    """
    Yield an Entry of each recording.

    ``force`` replaces results of something else, ``retry`` tries what failed for good again.
    """
    failures = read_json(out / FAILURES)
    for found in recordings:
        try:
            identity = identity_of(found.path, options)
        except RecordingError as error:
            yield Entry(found, FAILED, str(error))
            continue
        size = f'{identity["input"]["bytes"] / 1e6:.1f} MB'
        result = out / found.name
        manifest = manifest_of(result)
        before = failures.get(found.name, {})
        if manifest is not None:
            if manifest['identity'] == identity:
                wanted = evaluate and not (result / EVALUATION).is_file()
                yield Entry(found, EVALUATE if wanted else DONE, size, identity)
            elif force:
                yield Entry(found, AGAIN, size, identity)
            else:
                how = ', '.join(said for part, said in CHANGED.items()
                                if manifest['identity'].get(part) != identity[part])
                yield Entry(found, FAILED, f'{result} was made {how}; --force replaces it')
        elif is_taken(result):
            yield Entry(found, FAILED, f'{result} is there but no result: move it away')
        elif before.get('identity') == identity and before.get('lasting') and not retry:
            yield Entry(found, FAILED, str(before['reason']), identity, lasting=True)
        else:
            yield Entry(found, TO_DO, size, identity)


def is_taken(result: Path) -> bool:
    """Tell whether something else stands where a result would."""
    if result.is_dir():
        return not (result / MANIFEST).is_file() and any(result.iterdir())
    return result.exists()


def plan_lines(entries: Sequence[Entry], out: Path) -> Iterator[str]:
    """Yield the plan for people."""
    yield from in_columns([(entry.found.name, entry.state, entry.note)
                           for entry in entries if entry.state not in (DONE, FAILED)])
    counts = Counter(entry.state for entry in entries)
    yield f'{len(entries)} recordings into {out}: ' + ', '.join(
        f'{counts[state]} {state}' for state in (TO_DO, AGAIN, EVALUATE, DONE, FAILED)
        if counts[state])


def note_failures(out: Path, entries: Sequence[Entry], outcomes: Mapping[str, Outcome]) -> None:
    """Write the table of failures, of which the next call needs to know as well."""
    failures = {}
    for entry in entries:
        name = entry.found.name
        if entry.state == FAILED:
            failures[name] = {'reason': entry.note, 'lasting': entry.lasting,
                              'identity': entry.identity}
        elif name in outcomes and outcomes[name].failed:
            failures[name] = {'reason': outcomes[name].line, 'lasting': outcomes[name].lasting,
                              'identity': entry.identity}
    write_json(out / FAILURES, failures)
