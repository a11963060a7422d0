# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Results: a folder for each recording, whole or absent, with a manifest that says of what it is.

``DIR/NAME/`` holds ``manifest.json`` beside what ``replay`` has written. It is made in
``DIR/.partial/`` and renamed when all of it is on the disk: neither a crash nor a power cut leaves
anything else under its name.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict
import fcntl
from hashlib import sha256
import json
import os
from pathlib import Path
import shutil
from typing import Any, TypeAlias
from uuid import uuid4

from sph_stab_ros import __version__
from sph_stab_ros.config import Settings
from sph_stab_ros.recording import RecordingError
from sph_stab_ros.recording.partial_output import partial_output

MANIFEST, EVALUATION, FAILURES = 'manifest.json', 'evaluation.json', 'failures.json'
TRAJECTORY, VIDEO, BAG = 'trajectory.tum', 'stabilized.mp4', 'stabilized'
REPORT = 'report.html'
PARTIAL, LOCK = '.partial', '.lock'
# Those of parts of recordings, until they are joined.
SEGMENTS = '.segments'
# Of larger files the ends are hashed, and blocks between them.
WHOLE_BYTES = 64 * 2**20
BLOCK_BYTES = 2**16
BLOCKS = 64

# What a result is of, as JSON has it: the version, the recording's content and the options.
Identity: TypeAlias = dict[str, Any]


def identity_of(recording: Path, options: Mapping[str, Any]) -> Identity:
    """Return the Identity of the result of a recording; RecordingError if it is unreadable."""
    identity = {'version': __version__, 'input': content_of(recording), 'options': options}
    # As it is when it is read back.
    found: Identity = json.loads(json.dumps(identity))
    return found


def options_of(settings: Settings, others: dict[str, Any]) -> dict[str, Any]:
    """Return all that changes a result: parameters, what a mask shows, and ``others``."""
    mask = Path(settings.config.tracker.mask)
    shown = {'mask': sha256(mask.read_bytes()).hexdigest()} if mask.is_file() else {}
    return {**asdict(settings), **others, **shown}


def content_of(recording: Path) -> dict[str, Any]:
    """
    Return the size and the hash of a recording, whatever it is called.

    Of files of more than WHOLE_BYTES, ``BLOCKS`` blocks spread evenly from the first to the last
    byte are hashed: a copy with other pictures differs all over, as they are compressed.
    """
    try:
        files = sorted(path for path in recording.iterdir() if path.is_file()) if (
            recording.is_dir()) else [recording]
        # What SQLite has not yet taken in.
        files += [log for suffix in ('-wal', '-journal') if not recording.is_dir()
                  and (log := recording.with_name(recording.name + suffix)).is_file()]
        digest, total = sha256(), 0
        for file in files:
            size = file.stat().st_size
            digest.update(f'{size} '.encode())
            total += size
            with file.open('rb') as opened:
                if size <= WHOLE_BYTES:
                    while block := opened.read(2**20):
                        digest.update(block)
                else:
                    for number in range(BLOCKS):
                        opened.seek((size - BLOCK_BYTES) * number // (BLOCKS - 1))
                        digest.update(opened.read(BLOCK_BYTES))
        return {'bytes': total, 'files': len(files), 'sha256': digest.hexdigest()}
    except OSError as error:
        raise RecordingError(f'{recording} cannot be read: {error.strerror}') from error


def manifest_of(result: Path) -> dict[str, Any] | None:
    """Return the manifest of a result, None where there is none or a file of it is not whole."""
    manifest = read_json(result / MANIFEST)
    if not manifest:
        return None
    with suppress(OSError, KeyError, AttributeError):
        if all((result / name).stat().st_size == size
               for name, size in manifest['outputs'].items()):
            return manifest
    return None


def read_json(path: Path) -> dict[str, Any]:
    """Return what a file holds, nothing where it is not there or not JSON."""
    with suppress(OSError, ValueError):
        content = json.loads(path.read_text())
        if isinstance(content, dict):
            return content
    return {}


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a file, which is replaced when the new one is whole and on the disk."""
    with partial_output(path, force=True) as partial:
        partial.write_text(json.dumps(content, indent=2) + '\n')
        sync(partial)


def publish(partial: Path, result: Path, identity: Identity) -> None:
    """
    Let a folder become the result of its name.

    Where another process was faster with the same, its result stays and this one goes.
    """
    for path in sorted(partial.rglob('*'), reverse=True):
        sync(path)
    sync(partial)
    result.parent.mkdir(parents=True, exist_ok=True)
    try:
        partial.rename(result)
    except OSError:
        manifest = manifest_of(result)
        if not result.is_dir():
            raise
        if manifest is None or manifest['identity'] != identity:
            result.rename(partial.with_name(uuid4().hex))
            partial.rename(result)
    sync(result.parent)


def sync(path: Path) -> None:
    """Let the system write a file or folder to the disk now."""
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


@contextmanager
def results_folder(out: Path) -> Iterator[None]:
    """Make the folder of results, and keep other batches out of it while the block lasts."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with (out / LOCK).open('w') as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise RecordingError(f'another batch writes into {out}') from None
            except OSError:
                # Not every network's file system has locks.
                pass
            # Of a batch that was ended by force.
            clear(out)
            yield
    except OSError as error:
        raise RecordingError(f'{out} cannot be written: {error.strerror}') from error


def clear(out: Path, folder: str = PARTIAL) -> None:
    """Remove all that is not whole; processes that still write there end when they see it."""
    shutil.rmtree(out / folder, ignore_errors=True)
