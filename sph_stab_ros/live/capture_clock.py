# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""When pictures of a stream were taken, by the sender's clock or by their arrival here."""

from sph_stab_ros.geometry.conventions import NS_PER_S

ARRIVAL, DEVICE, SENDER = 'arrival', 'device', 'sender'
# A clock that is set shows a time before the arrival, and none long before.
MOST_AHEAD_NS, MOST_DELAY_NS = NS_PER_S // 20, 2 * NS_PER_S
# Beyond, a stream counts from another time on.
MOST_JITTER_NS = 2 * NS_PER_S
# Clocks drift apart, and the times of some streams are those of a rate that they do not keep: for
# so long the least delay counts, for stamps, and to tell who is late.
WINDOW_NS, LATE_WINDOW_NS = 2 * NS_PER_S, 60 * NS_PER_S
# With which AVProducerReferenceTime begins, in microseconds.
TIME_BYTES = 8


class Minimum:
    """The least of what was added in the last window of time, or in the last two."""

    def __init__(self, window_ns: int) -> None:
        self.value: int | None = None
        self._window_ns, self._begin_ns = window_ns, 0
        self._present = 0

    def add(self, value: int, now_ns: int) -> int:
        """Add a value; return the least one."""
        if self.value is None:
            self._begin_ns, self._present = now_ns, value
            self.value = value
        elif now_ns - self._begin_ns > self._window_ns:
            self._begin_ns, self.value = now_ns, min(self._present, value)
            self._present = value
        else:
            self._present, self.value = min(self._present, value), min(self.value, value)
        return self.value


class CaptureClock:
    """
    Gives pictures their stamps, in ns since 1970, which never go back nor lie in the future.

    A stream counts from a time of its own. What must be added to that is told by the sender
    (RTCP) or the device, or else, and where their clocks are not set, by the arrival of the packet
    of the last seconds that was delayed least: how long others were held up on the way is nobody's
    motion.

    ``name`` says which clock it is, ``late_ns`` by how much more the last packet was delayed than
    the least delayed one of the last minute.
    """

    def __init__(self) -> None:
        self._last_ns = 0
        self.restart()

    def restart(self) -> None:
        """Begin with another connection."""
        self.name, self.late_ns = ARRIVAL, 0
        self._told: tuple[str, int] | None = None
        # What must be added by the arrivals, in the last seconds and in the last minute.
        self._recent, self._lately = Minimum(WINDOW_NS), Minimum(LATE_WINDOW_NS)
        self._pts_ns: int | None = None

    def arrive(self, pts_ns: int, arrival_ns: int) -> None:
        """Take in when a packet has come, of a picture with this time by the stream."""
        offset_ns = arrival_ns - pts_ns
        least_ns = self._recent.value
        if least_ns is not None and abs(offset_ns - least_ns) > MOST_JITTER_NS:
            self._recent, self._lately = Minimum(WINDOW_NS), Minimum(LATE_WINDOW_NS)
        self._recent.add(offset_ns, arrival_ns)
        self.late_ns = offset_ns - self._lately.add(offset_ns, arrival_ns)

    def hear_sender(self, side_data: bytes, pts_ns: int) -> None:
        """Take in what RTCP says of a packet: the side data "producer reference time"."""
        captured_us = int.from_bytes(side_data[:TIME_BYTES], 'little', signed=True)
        self._told = SENDER, 1000 * captured_us - pts_ns

    def hear_device(self, pts_ns: int, arrival_ns: int, monotonic_ns: int) -> None:
        """Take in the time of a device's picture, by the system's steady clock or the other."""
        is_steady = -MOST_AHEAD_NS <= monotonic_ns - pts_ns <= MOST_DELAY_NS
        self._told = DEVICE, arrival_ns - monotonic_ns if is_steady else 0

    def stamp_ns(self, pts_ns: int | None, arrival_ns: int) -> int:
        """Return the stamp of a picture, of this time by the stream if it has any."""
        stamp_ns, step_ns, self.name = arrival_ns, 0, ARRIVAL
        if pts_ns is not None and self._recent.value is not None:
            stamp_ns = pts_ns + self._recent.value
            if self._told is not None:
                name, offset_ns = self._told
                if -MOST_AHEAD_NS <= arrival_ns - pts_ns - offset_ns <= MOST_DELAY_NS:
                    stamp_ns, self.name = pts_ns + offset_ns, name
            step_ns = 0 if self._pts_ns is None else max(pts_ns - self._pts_ns, 0)
            self._pts_ns = pts_ns
        # Where a better clock shows an earlier time pictures go on at half their pace until then.
        goes_on_ns = self._last_ns + max(step_ns // 2, 1)
        self._last_ns = min(max(stamp_ns, goes_on_ns), max(arrival_ns, self._last_ns + 1))
        return self._last_ns
