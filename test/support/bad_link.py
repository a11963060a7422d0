# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
A bad radio link: a network namespace that is reached through a process which delays and loses.

What is started ``inside`` it is at the far end, everything else at the near one; they see each
other by their addresses, ``near`` and ``far``. Each IP packet, in either direction, waits for its
turn at the rate of the link, takes half the round trip, and may get lost: with a probability,
where too many wait, or while the link is silent. That takes root, iproute2 and /dev/net/tun.
"""

from collections import deque
from contextlib import contextmanager
import ctypes
from fcntl import ioctl
import os
from pathlib import Path
import random
import select
import shutil
from struct import pack
import subprocess
import sys
import time

OWN_NAMESPACE = '/proc/thread-self/ns/net'
CLONE_NEWNET = 0x40000000
TUN = '/dev/net/tun'
TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454ca, 1, 0x1000
MAX_PACKET_BYTES = 1 << 16
SILENT, HEARD = b's', b'h'


def why_not():
    """Return why there can be no link here, '' where there can."""
    return next((why for missing, why in (
        (os.geteuid(), 'no root'), (not os.path.exists(TUN), f'no {TUN}'),
        (not shutil.which('ip'), 'no ip command')) if missing), '')


class BadLink:
    """
    A link while its context lasts.

    Parameters
    ----------
    rate_mbit_s, round_trip_s, loss
        Of either direction; the share of packets that get lost.
    queue_s
        How long a packet may wait for its turn; then others are lost.

    """

    def __init__(self, rate_mbit_s=6., round_trip_s=0.04, loss=0.01, queue_s=0.25):
        self._values = rate_mbit_s, round_trip_s, loss, queue_s
        process = os.getpid()
        self._name = f'bad_link_{process}'
        # Of its own, as tests may run side by side.
        self.near, self.far = (f'10.254.{process >> 6 & 255}.{4 * (process & 63) + end}'
                               for end in (1, 2))
        self._carrier = None

    def __enter__(self):
        """Begin."""
        ip('netns', 'add', self._name)
        try:
            with self.inside():
                ip('link', 'set', 'lo', 'up')
                far = tunnel('far', self.far, self.near)
            near = tunnel(f'near{os.getpid()}', self.near, self.far)
            ends = near, far
            self._carrier = subprocess.Popen(
                [sys.executable, __file__, *map(str, (*ends, *self._values))], pass_fds=ends,
                stdin=subprocess.PIPE)
            for end in ends:
                os.close(end)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_):
        """End; its addresses are gone."""
        if self._carrier:
            self._carrier.stdin.close()
            self._carrier.wait()
        ip('netns', 'del', self._name)

    @contextmanager
    def inside(self):
        """Let this thread start processes and open sockets at the far end; they stay there."""
        with open(OWN_NAMESPACE) as own, open(Path('/run/netns') / self._name) as namespace:
            set_namespace(namespace)
            try:
                yield
            finally:
                set_namespace(own)

    def fall_silent(self, silent=True):
        """Lose everything from now on, or no longer."""
        self._carrier.stdin.write(SILENT if silent else HEARD)
        self._carrier.stdin.flush()


def ip(*arguments):
    """Run the ip command."""
    subprocess.run(['ip', *arguments], check=True, capture_output=True)


def set_namespace(file):
    """Move this thread to a network namespace."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.setns(file.fileno(), CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), 'setns')


def tunnel(name, address, other):
    """Return the descriptor of a device that has an address and leads to another."""
    descriptor = os.open(TUN, os.O_RDWR)
    ioctl(descriptor, TUNSETIFF, pack('16sH22x', name.encode(), IFF_TUN | IFF_NO_PI))
    ip('addr', 'add', address, 'peer', other, 'dev', name)
    ip('link', 'set', name, 'up')
    return descriptor


class Direction:
    """Packets on their way from one end to the other."""

    def __init__(self, source, target, rate_mbit_s, round_trip_s, loss, queue_s):
        self.source, self._target = source, target
        self._bytes_per_s, self._delay_s = 1e6 / 8 * rate_mbit_s, round_trip_s / 2
        self._loss, self._queue_s = loss, queue_s
        self._packets = deque()
        self._free_s = 0.

    def take(self, silent):
        """Take a packet in."""
        packet = os.read(self.source, MAX_PACKET_BYTES)
        now_s = time.monotonic()
        start_s = max(now_s, self._free_s)
        if silent or random.random() < self._loss or start_s > now_s + self._queue_s:
            return
        self._free_s = start_s + len(packet) / self._bytes_per_s
        self._packets.append((self._free_s + self._delay_s, packet))

    def deliver(self):
        """Hand over what has arrived; return seconds until the next will."""
        while self._packets and self._packets[0][0] <= time.monotonic():
            os.write(self._target, self._packets.popleft()[1])
        return max(0, self._packets[0][0] - time.monotonic()) if self._packets else 1.


def carry(near, far, *values):
    """Carry packets between two descriptors until the standard input ends."""
    directions = Direction(near, far, *values), Direction(far, near, *values)
    commands, silent = sys.stdin.fileno(), False
    while True:
        wait_s = min(direction.deliver() for direction in directions)
        readable = select.select([near, far, commands], (), (), wait_s)[0]
        if commands in readable:
            command = os.read(commands, 1)
            if not command:
                return
            silent = command == SILENT
        for direction in directions:
            if direction.source in readable:
                direction.take(silent)


if __name__ == '__main__':
    carry(*map(int, sys.argv[1:3]), *map(float, sys.argv[3:]))
