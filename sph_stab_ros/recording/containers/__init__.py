# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""
The containers of ROS's bags: which one a file is, and what it holds, whole or damaged.

All are sequences that can be read front to back without their index, and that is how they are
read: nothing depends on an index that a recorder did not live to write, or that is wrong without
showing it. Messages come in the order of recording.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
import logging
from pathlib import Path, PurePath
from typing import Any, NamedTuple
import warnings

from ruamel.yaml import YAML

from sph_stab_ros.recording.base import RecordingError
from sph_stab_ros.recording.containers.kinds import kind_of, refuse_if_known
from sph_stab_ros.recording.containers.limits import Damage
from sph_stab_ros.recording.containers.records import Channel, Message, Part
from sph_stab_ros.recording.containers.temporary_copies import Copies

__all__ = ['Channel', 'Containers', 'is_bag', 'Message']

logger = logging.getLogger(__name__)

METADATA = 'metadata.yaml'
# Endings of files in which there is one each.
PICTURES = ('.jpg', '.jpeg', '.png', '.tif', '.tiff', '.dng', '.webp', '.exr')
# Of the longest one there may be, with the definitions of all its messages.
MOST_METADATA_BYTES = 2**26


def is_bag(path: Path) -> bool:
    """Tell whether there is a bag at ``path``, a video perhaps if not; refuse what is neither."""
    try:
        if path.is_dir() or kind_of(path) is not None:
            return True
        refuse_if_known(path)
        return False
    except OSError as error:
        raise RecordingError(f'{path} cannot be read: {error.strerror}') from None


class Containers:
    """
    The files of one bag: a single one, or a folder of them.

    ``channels`` counts the messages of each channel, as an index says where there is one.
    """

    def __init__(self, path: Path) -> None:
        self.channels: Counter[Channel] = Counter()
        # What was broken before any message is read.
        self._damage = Damage()
        self._copies = Copies()
        try:
            self._parts = self._opened(path)
        except OSError as error:
            raise RecordingError(f'{path} cannot be read: {error.strerror}') from None

    def messages(self, topic: str, damage: list[str]) -> Iterator[Message]:
        """Yield the messages of a topic; add to ``damage`` what is broken."""
        damage += self._damage
        missing = sum(count for channel, count in self.channels.items() if channel.topic == topic)
        for part in self._parts:
            try:
                for message in part.scan(damage, (topic,)):
                    yield message
                    missing -= 1
            except OSError as error:
                damage.append(str(error))
        if missing > 0 and not damage:
            damage.append(f'{missing} messages fewer than the index says')

    def _opened(self, path: Path) -> list[Part]:
        """Return the parts of the bag in their order."""
        listed = listed_parts(path)
        files = listed or bag_files(path, self._damage)
        if not files:
            raise RecordingError(f'{path} is not a readable bag: {what_else(path)}')
        kinds = {kind for file in files if (kind := kind_of(file))}
        if len(kinds) > 1:
            raise RecordingError(f'{path} holds bags of several kinds, give one of them: '
                                 f'{", ".join(file.name for file in files)}')
        parts = [self._summary_of(kind(self._copies.readable(file, self._damage)))
                 for file in files for kind in kinds]
        if not listed:
            parts = without_copies(path.name, parts)
            # Names do not sort like numbers; parts without messages come last.
            parts.sort(key=lambda one: (one.first_ns is None, one.first_ns or 0))
        for one in parts:
            self.channels.update(one.counts)
        return [one.part for one in parts]

    def _summary_of(self, part: Part) -> 'Summary':
        """Count a part's messages, and find when they begin."""
        counts = part.index()
        channel, first_ns, _ = next(part.scan(Damage()), (None, None, b''))
        if (counts is None or channel is not None and channel not in counts
                or counts.total() > part.path.stat().st_size):
            # There is no index, or it contradicts what it stands for.
            counts = Counter(channel for channel, _, _ in part.scan(Damage()))
            counts.update(dict.fromkeys(part.channels(), 0))
        return Summary(part, first_ns, counts)


class Summary(NamedTuple):
    """What is known of a part before it is read; the time in ns of its first message, if any."""

    part: Part
    first_ns: int | None
    counts: Counter[Channel]


def without_copies(name: str, parts: list[Summary]) -> list[Summary]:
    """Return the parts, of those that begin at the same time the one that holds most."""
    best: dict[int, Summary] = {}
    for one in parts:
        if one.first_ns is not None:
            other = best.setdefault(one.first_ns, one)
            if one.counts.total() > other.counts.total():
                best[one.first_ns] = one
    kept = [one for one in parts if one.first_ns is None or best[one.first_ns] is one]
    if len(kept) < len(parts):
        logger.warning('%s holds copies of the same recording: the longest is read', name)
    return kept


def bag_files(path: Path, damage: list[str]) -> list[Path]:
    """Return the bags at ``path``: itself, or those in a folder, by their content."""
    if not path.is_dir():
        return [path]
    files = [file for file in sorted(path.iterdir()) if file.is_file()]
    bags = [file for file in files if kind_of(file) is not None]
    names = {file.name for file in bags}
    damage += [f'{file.name} is empty' for file in files
               if file.suffix in ('.mcap', '.db3') and file.stat().st_size == 0]
    # Tools leave what they have unpacked beside what it was packed in.
    return [file for file in bags if file.suffix not in ('.zstd', '.zst') or
            file.stem not in names]


def what_else(folder: Path) -> str:
    """Return what a folder holds that holds no bag, in a line."""
    names = sorted(one.name for one in folder.iterdir())
    if not names:
        return 'the folder is empty'
    advice = ('make a video of the pictures first' if names[-1].lower().endswith(PICTURES)
              else 'give what is to be read by its own name')
    return f'of {len(names)} files in the folder, such as {names[-1]}, none is one: {advice}'


def listed_parts(path: Path) -> list[Path]:
    """Return the files that the metadata in a folder list, where all of them are there."""
    text = path / METADATA
    if not text.is_file() or text.stat().st_size > MOST_METADATA_BYTES:
        return []
    content: Any = None
    # Damaged metadata are done without: in whatever way they are.
    with suppress(Exception), warnings.catch_warnings():
        warnings.simplefilter('ignore')
        content = YAML(typ='safe').load(text.read_text('utf-8'))
        names = content['rosbag2_bagfile_information']['relative_file_paths']
        files = [path / name for name in dict.fromkeys(PurePath(one).name for one in names)]
        if all(file.is_file() and kind_of(file) for file in files):
            others = {file.name for file in bag_files(path, [])} - {file.name for file in files}
            if others:
                logger.warning('%s: left out, as its %s does not list it: %s', path.name,
                               METADATA, ', '.join(sorted(others)))
            return files
    return []
