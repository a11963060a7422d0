# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the text of a live source means: which device, stream, pipe or file, and how to open it."""

from enum import Enum
from pathlib import Path
import re
from typing import NamedTuple

# FFmpeg reads no more than this before it says what a stream is, in bytes and microseconds. What
# it has read is not lost: it comes first. ("fflags nobuffer" would drop it, and with it the key
# picture that all others need up to the next one.)
PROBING = {'probesize': '300000', 'analyzeduration': '1000', 'fpsprobesize': '0'}
# Datagrams carry MPEG-TS, which says ten times a second what is in it. A packet of it is a whole
# picture; to parse it FFmpeg would wait for the beginning of the one after the next, another
# period.
DATAGRAMS = {'probesize': '1000000', 'fflags': 'noparse+nofillin'}
RTSP = {'rtsp_flags': 'prefer_tcp'}
# Drivers take the nearest size that they have, here the largest. Raw pictures of that size come
# a few times a second over USB, so of these the driver's own choice is left.
LARGEST = '16384x8192'
DEVICE_CHOICES: tuple[dict[str, str], ...] = (
    {'input_format': 'mjpeg', 'video_size': LARGEST},
    {'input_format': 'h264', 'video_size': LARGEST}, {})
# Options by which a user has chosen.
CHOOSING = {'input_format', 'pixel_format', 'video_size'}
DEVICE = re.compile(r'/dev/(video\d+|v4l/.+)')
# The other one is FFmpeg's, and easier to write in YAML.
STANDARD_INPUT = ('-', 'pipe:0')
# What is done with a bag.
PLAYED = "'ros2 run sph_stab_ros player BAG' plays its images on a topic"
SCHEME = re.compile(r'([a-z][a-z0-9+.-]*)://', re.IGNORECASE)
PASSWORD = re.compile(r'(?<=://)([^/@:]*):[^/@]*@')


class SourceError(ValueError):
    """A source that cannot be read, in one line for the user."""


class Kind(Enum):
    """What sources have in common by which they are read."""

    DEVICE = 'device'
    STREAM = 'stream'
    PIPE = 'pipe'
    FILE = 'file'


class Address(NamedTuple):
    """
    How FFmpeg opens a source: ``url``, ``format``, and sets of options to try one after the other.

    ``name`` is what users are shown, without a password.
    """

    name: str
    kind: Kind
    url: str
    format: str | None  # noqa: A003
    choices: tuple[dict[str, str], ...]

    @property
    def scheme(self) -> str:
        """Return the protocol of a stream, '' of what is none."""
        found = SCHEME.match(self.url)
        return found[1].lower() if found else ''

    @property
    def may_be_finite(self) -> bool:
        """Tell whether this is a recording where it says how long it is, whose time we keep."""
        return self.kind in (Kind.FILE, Kind.PIPE) or self.scheme in ('http', 'https')


def address_of(text: str, options: str = '') -> Address:
    """
    Return the Address in ``text``; SourceError where there is none.

    Parameters
    ----------
    text
        ``/dev/video0``, ``rtsp://…`` or another protocol of FFmpeg's, ``-`` for standard input, or
        the path of a file.
    options
        Options of FFmpeg, ``NAME=VALUE,NAME=VALUE``, over those chosen here.

    """
    given = given_options(options)
    form = given.pop('format', None)
    if text in STANDARD_INPUT:
        return Address('standard input', Kind.PIPE, 'pipe:0', form, ({**PROBING, **given},))
    if DEVICE.fullmatch(text):
        choices = ({},) if CHOOSING & given.keys() else DEVICE_CHOICES
        return Address(text, Kind.DEVICE, text, form or 'v4l2',
                       tuple({**one, **given} for one in choices))
    scheme = SCHEME.match(text)
    if scheme and scheme[1].lower() != 'file':
        chosen = dict(PROBING)
        if scheme[1].lower() in ('udp', 'srt'):
            chosen |= DATAGRAMS
            form = form or 'mpegts'
        elif scheme[1].lower() in ('rtsp', 'rtsps'):
            chosen |= RTSP
        return Address(PASSWORD.sub(r'\1:***@', text), Kind.STREAM, text, form,
                       ({**chosen, **given},))
    path = Path(text[scheme.end():] if scheme else text)
    if path.is_dir():
        raise SourceError(f"source: '{path}' is a folder; if that is a bag, {PLAYED}")
    if not path.is_file():
        raise SourceError(f"source: there is no file '{path}', and no protocol:// begins it")
    return Address(str(path), Kind.FILE, f'file:{path}', form, (given,))


def file_of(address: Address) -> Path:
    """Return the path of a file's Address."""
    return Path(address.url.removeprefix('file:'))


def given_options(text: str) -> dict[str, str]:
    """Return options of FFmpeg by name."""
    options = {}
    for one in filter(None, text.split(',')):
        name, equals, value = one.partition('=')
        if not (name.strip() and equals):
            raise SourceError(f"source_options: '{one}' is not NAME=VALUE")
        options[name.strip()] = value.strip()
    return options
