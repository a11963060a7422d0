# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the command-line tools share: one line for an error, exit 2 for a usage error, 1 else."""

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from io import TextIOWrapper
import logging
import math
import os
from pathlib import Path
import signal
import sys
from typing import Any, NoReturn

from sph_stab_ros.command_line.arguments import seconds_argument, whole_number
from sph_stab_ros.command_line.process_setup import set_up_process
from sph_stab_ros.recording import open_recording, Recording, RecordingError

# StsNoMem, the code of cv2.error.
OPENCV_NO_MEMORY = -4


class Parser(argparse.ArgumentParser):
    """An argument parser that says what is wrong in one line, without the usage before it."""

    def error(self, message: str) -> NoReturn:
        """Exit with status 2."""
        self.exit(2, f'{self.prog}: {one_line(message)}\n')

    def parse_in_any_order(self, args: Sequence[str] | None) -> argparse.Namespace:
        """Return parsed arguments, options and names mixed; behind ``--`` there are only names."""
        given = list(sys.argv[1:] if args is None else args)
        if '--' in given:
            # argparse forgets it between its two passes.
            at = given.index('--')
            given[at:] = [f'./{one}' if one.startswith('-') else one for one in given[at + 1:]]
        return self.parse_intermixed_args(given)


def add_recording(parser: argparse.ArgumentParser, name: str) -> None:
    """Add arguments for a recording to read, called ``name``, and for what of it."""
    parser.add_argument('recording', metavar=name, type=Path,
                        help='rosbag2 folder, .mcap, .db3, ROS 1 .bag, or a video file; - is a '
                        'video through standard input')
    add_selection(parser)


def add_selection(parser: argparse.ArgumentParser) -> None:
    """Add arguments for what of a recording to read."""
    parser.add_argument('--image-topic', metavar='TOPIC',
                        help='where the images are in a bag with several image topics; with '
                        'join A,B for two lenses')
    parser.add_argument('--start', metavar='SECONDS', type=seconds_argument, default=0.,
                        help='leave out what comes before, counted from the first picture')
    parser.add_argument('--end', metavar='SECONDS', type=seconds_argument, default=math.inf,
                        help='leave out what comes then and later')
    parser.add_argument('--max-frames', metavar='N', type=whole_number(1),
                        help='stop after N pictures')


def check_stretch(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Exit 2 where no picture can be between ``--start`` and ``--end``."""
    if args.end <= args.start:
        parser.error('--end comes after --start')


def open_given(args: argparse.Namespace, join: str) -> Recording:
    """Return the Recording that the arguments of ``add_recording`` name, or its stretch."""
    return open_recording(args.recording, args.image_topic, args.start, args.end, join)


def is_cut(args: argparse.Namespace) -> bool:
    """Tell whether arguments ask for less than the end of the recording."""
    return args.max_frames is not None or args.end < math.inf


def given(args: argparse.Namespace, names: Iterable[str]) -> dict[str, Any]:
    """Return those arguments by names that are given: none of absence, no end and no beginning."""
    return {name: getattr(args, name) for name in names
            if getattr(args, name) not in (None, False, 0., math.inf)}


def add_imu_topic(parser: argparse.ArgumentParser) -> None:
    """Add an argument for the IMU that ``level: imu`` needs."""
    parser.add_argument('--imu-topic', metavar='TOPIC',
                        help='where the IMU of "level: imu" is in a bag with several')


def frames_to_read(recording: Recording, max_frames: int | None) -> int | None:
    """Return how many pictures a Recording has, ``max_frames`` at most; None if unknown."""
    return min(filter(None, (recording.frame_count, max_frames)), default=None)


def one_line(text: object) -> str:
    """Return a text as it can be printed in a line, whatever names of files and topics hold."""
    return ''.join(one if one.isprintable() else one.encode('unicode_escape').decode()
                   for one in str(text))


class OneLine(logging.Formatter):
    """Logs each message in a line of its own."""

    def format(self, record: logging.LogRecord) -> str:  # noqa: A003
        """Return the line."""
        return one_line(super().format(record))


class TellOnce(logging.Filter):
    """Lets each message of the log through, word for word, once."""

    def __init__(self) -> None:
        super().__init__()
        self._told: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:  # noqa: A003
        """Tell whether the message has not been told."""
        count = len(self._told)
        self._told.add(record.getMessage())
        return len(self._told) > count


@contextmanager
def told_once() -> Iterator[None]:
    """Have each message of the log told once only."""
    filters = [(handler, TellOnce()) for handler in logging.getLogger().handlers]
    for handler, one in filters:
        handler.addFilter(one)
    try:
        yield
    finally:
        for handler, one in filters:
            handler.removeFilter(one)


def is_out_of_memory(error: Exception) -> bool:
    """Tell whether an error is that memory has run out, in Python, NumPy or OpenCV."""
    return isinstance(error, MemoryError) or getattr(error, 'code', 0) == OPENCV_NO_MEMORY


def run(name: str, command: Callable[[], object]) -> int:
    """
    Return the exit status of ``command()``: 0, or 1 after a line on stderr.

    Warnings of the library go to stderr. SIGTERM ends the command as Ctrl-C does.
    """
    for stream in ('stdout', 'stderr'):
        # Closed by whoever started us.
        if getattr(sys, stream) is None:
            setattr(sys, stream, open(os.devnull, 'w'))
    handler = logging.StreamHandler()
    handler.setFormatter(OneLine(f'{name}: %(message)s'))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    # SIGINT too: what a script starts in the background would ignore it.
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, signal.default_int_handler)
    if isinstance(sys.stdout, TextIOWrapper):
        # Whatever names hold, and whatever the locale: as it is with stderr.
        sys.stdout.reconfigure(errors='backslashreplace')
    set_up_process()
    try:
        command()
        sys.stdout.flush()
    except RecordingError as error:
        print(f'{name}: {one_line(error)}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f'{name}: interrupted', file=sys.stderr)
        return 1
    except OSError as error:
        # Whoever has read the beginning may have seen enough.
        if not isinstance(error, BrokenPipeError):
            print(f'{name}: {one_line(error)}', file=sys.stderr)
        # Python must not flush the rest either.
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        print(f'{name}: there is not enough memory', file=sys.stderr)
        return 1
    return 0
