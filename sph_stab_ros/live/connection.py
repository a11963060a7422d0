# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""An open source: how it is opened, why it cannot be, and when its packets are due."""

from collections.abc import Iterator
from contextlib import contextmanager
from errno import EINVAL
from threading import Event
from time import monotonic
from typing import Any, TYPE_CHECKING

from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.images.video.decoder import INSTALL
from sph_stab_ros.live.address import Address, Kind, SourceError

if TYPE_CHECKING:
    import av

# What does not come for so long does not come.
OPEN_S, READ_S = 10., 5.
# AVFMT_NOTIMESTAMPS of FFmpeg's: what such formats show as times is made up.
NO_TIMES = 0x80
# And what such as these show is counted by a rate that they may not keep.
COUNTED = ('rawvideo', 'yuv4mpegpipe')
# Containers that tell which pictures are key pictures; of others FFmpeg's parsers may.
KEYED = 'matroska', 'mov', 'flv'
# libavformat of FFmpeg 8.1. With 8.0 a process that listens for RTMP ends by a segmentation fault.
RTMP_SERVER = 62, 12
# Who does not wait so long for a packet in so much time cannot keep up with them; who is so late
# only keeps up if waiting takes longer than the work, since reading may wait for other threads.
WAITED_S, PATIENCE_S = 0.01, 1.
MOST_LATE_NS, CAUGHT_UP_NS = NS_PER_S // 2, NS_PER_S // 10


@contextmanager
def opened(address: Address) -> Iterator['av.container.InputContainer']:
    """Give the open container, by the first choice of options that the source takes."""
    import av
    # A pipe cannot be opened again: who writes into it takes the time that it takes.
    timeout = None if address.kind is Kind.PIPE else (OPEN_S, READ_S)
    for options in address.choices:
        try:
            container = av.open(address.url, format=address.format, options=options,
                                timeout=timeout, metadata_errors='replace')
        except av.FFmpegError as error:
            # So the driver of a device says that it does not have such pictures.
            if error.errno != EINVAL or options is address.choices[-1]:
                raise
        else:
            break
    with container:
        yield container


def is_recording(address: Address, container: 'av.container.InputContainer') -> bool:
    """Tell whether it is us who let the time of the pictures pass."""
    return address.may_be_finite and bool(container.duration)


def has_times(container: 'av.container.InputContainer') -> bool:
    """Tell whether the times of packets are those of pictures."""
    form = container.format
    return not (form.flags & NO_TIMES or form.name.endswith('_pipe') or form.name in COUNTED)


def tells_keys(container: 'av.container.InputContainer') -> bool:
    """Tell whether it is known of each packet whether that is a key picture."""
    return container.format.name.startswith(KEYED)


def reason_of(error: Exception, address: Address) -> tuple[str, bool]:
    """Return in words why a source cannot be read, and whether that will stay so."""
    import av
    if isinstance(error, SourceError):
        return str(error), False
    if isinstance(error, av.ProtocolNotFoundError):
        return f"this FFmpeg has no protocol '{address.scheme}'", True
    if isinstance(error, (av.DemuxerNotFoundError, av.OptionNotFoundError)):
        return str(error.strerror).lower(), True
    if isinstance(error, av.ExitError):
        return 'nothing that is video comes', False
    if isinstance(error, av.InvalidDataError):
        return 'what comes cannot be read as video', False
    if isinstance(error, av.FFmpegError):
        return f'it cannot be read: {error.strerror}', False
    if isinstance(error, ValueError) and 'no container format' in str(error):
        return str(error), True
    return f'it cannot be read: {error!r}', False


class Pace:
    """Lets the packets of a recording wait for their time."""

    def __init__(self, closing: Event) -> None:
        self._closing = closing
        self._begin_s: float | None = None

    def wait(self, packet: 'av.Packet[Any]') -> None:
        """Wait until a packet is due."""
        if packet.dts is None or not packet.time_base:
            return
        at_s = float(packet.dts * packet.time_base)
        if self._begin_s is None:
            self._begin_s = monotonic() - at_s
        self._closing.wait(max(self._begin_s + at_s - monotonic(), 0))


class Backlog:
    """
    Tells whether packets must be left out, since they come faster than they are decoded.

    Told, by the steady clock, when reading begins and ends; and by how much the packet that was
    read comes later than the least delayed ones.
    """

    def __init__(self) -> None:
        self._leaves_out = False
        self._begin_s = self._worked_s = 0.
        self._kept_up_s: float | None = None

    def begin(self, now_s: float, worked_s: float) -> None:
        """Begin to read, after so much work on the packet before."""
        self._begin_s = now_s
        # Those that are left out are none.
        self._worked_s = self._worked_s if self._leaves_out else worked_s

    def is_too_long(self, now_s: float, late_ns: int) -> bool:
        """End to read; packets are left out until one has to be waited for."""
        is_late = late_ns > (CAUGHT_UP_NS if self._leaves_out else MOST_LATE_NS)
        waited_s = now_s - self._begin_s
        if self._kept_up_s is None or waited_s > (self._worked_s if is_late else WAITED_S):
            self._leaves_out, self._kept_up_s = False, now_s
        self._leaves_out |= now_s - self._kept_up_s > PATIENCE_S
        return self._leaves_out


def require_pyav(address: Address) -> None:
    """Raise SourceError where there is no PyAV, or none that can read an address."""
    try:
        import av
    except ImportError:
        raise SourceError(f'a source {INSTALL}') from None
    is_server = address.scheme.startswith('rtmp') and 'listen' in address.choices[0]
    if is_server and av.library_versions['libavformat'] < RTMP_SERVER:
        raise SourceError('listening for RTMP needs PyAV 17.1 or newer: with the FFmpeg of this '
                          'one it ends the process')
