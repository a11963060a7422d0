# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Outputs that are either complete or clearly marked.

Each is written in a folder beside its destination, named after it with ``.partial`` behind, and
moved out of it when it is whole.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
import json
import logging
import os
from pathlib import Path
import shutil

from sph_stab_ros.recording.base import RecordingError

logger = logging.getLogger(__name__)


@contextmanager
def partial_output(path: str | Path, force: bool = False, holds: Sequence[str] = ()
                   ) -> Iterator[Path]:
    """
    Give a path to write a file or folder to, which becomes ``path`` when the block ends well.

    An error removes what was written; KeyboardInterrupt leaves it in its ``.partial`` folder for
    whoever had to stop a long run. RecordingError if ``path`` exists and not ``force``, or where
    it cannot be written; what ``path`` held before stays until the new output is whole. A folder
    is replaced only where all in it is named by the patterns that it ``holds``. Pipes and devices
    are written to as they are.
    """
    path = Path(path)
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            yield path
        else:
            refuse_to_replace(path, force, holds)
            # What a link points at is replaced.
            with replaced_when_whole(Path(os.path.realpath(path))) as partial:
                yield partial
    except OSError as error:
        raise RecordingError(f'{path} cannot be written: {error.strerror or error}') from error


def write_json(path: Path, content: object) -> None:
    """Write content as JSON, whole, over what was there; RecordingError where that cannot be."""
    with partial_output(path, force=True) as partial:
        partial.write_text(json.dumps(content, indent=2) + '\n')


def add_to_json(path: Path, **added: object) -> None:
    """Write what a JSON file holds, if there is one, and what is added by key; as write_json."""
    write_json(path, {**(json.loads(path.read_text()) if path.exists() else {}), **added})


def refuse_to_replace(path: Path, force: bool, holds: Sequence[str]) -> None:
    """Raise RecordingError where a path exists and is not to be replaced."""
    if path.exists() and not force:
        raise RecordingError(f'{path} exists already; --force replaces it')
    others = [one.name for one in sorted(path.iterdir())
              if one.is_dir() or not any(map(one.match, holds))] if path.is_dir() else []
    if others or path.is_dir() and not holds:
        raise RecordingError(f'{path} is a folder of something else'
                             f'{f", such as {others[0]}" if others else ""}: it is not replaced')


@contextmanager
def replaced_when_whole(path: Path) -> Iterator[Path]:
    """Give a path to write to, which becomes another one when the block ends well."""
    folder = path.with_name(f'{path.name}.partial')
    try:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        yield folder / path.name
        if path.is_dir():
            path.rename(folder / 'replaced')
        (folder / path.name).replace(path)
    except KeyboardInterrupt:
        logger.warning('what was written until then is in %s', folder)
        raise
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    shutil.rmtree(folder, ignore_errors=True)
