# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The link that the operator's page is tried over is as bad as it says."""

import socket
from threading import Thread
import time

from bad_link import BadLink, why_not
import pytest

pytestmark = pytest.mark.skipif(bool(why_not()), reason=why_not())
TIMEOUT_S = 20.


def sockets(link, kind):
    """Return a socket at either end, which can be reached there."""
    near = socket.socket(type=kind)
    with link.inside():
        far = socket.socket(type=kind)
    for end, address in ((near, link.near), (far, link.far)):
        end.settimeout(TIMEOUT_S)
        end.bind((address, 0))
    return near, far


def test_nothing_is_faster_than_the_link():
    with BadLink(rate_mbit_s=8, round_trip_s=0.1, loss=0, queue_s=10) as link:
        near, far = sockets(link, socket.SOCK_STREAM)
        with near, far:
            near.listen()
            before_s = time.monotonic()
            far.connect(near.getsockname())
            connected_s = time.monotonic()
            assert connected_s - before_s >= 0.1
            received, _ = near.accept()
            received.settimeout(TIMEOUT_S)
            with received:
                sending = Thread(target=received.sendall, args=(bytes(500_000),))
                sending.start()
                got = 0
                while got < 500_000:
                    got += len(far.recv(1 << 16))
                sending.join()
            assert time.monotonic() - connected_s >= 0.5


def test_packets_get_lost():
    with BadLink(rate_mbit_s=100, loss=0.5) as link:
        near, far = sockets(link, socket.SOCK_DGRAM)
        with near, far:
            for n in range(200):
                near.sendto(bytes([n]), far.getsockname())
            far.settimeout(1)
            got = []
            try:
                while True:
                    got.append(far.recv(10)[0])
            except TimeoutError:
                pass
            assert 50 < len(got) < 150
            assert got == sorted(got)


def test_what_is_sent_while_it_is_silent_is_lost():
    with BadLink(loss=0) as link:
        near, far = sockets(link, socket.SOCK_DGRAM)
        with near, far:
            link.fall_silent()
            time.sleep(0.2)
            far.sendto(b'first', near.getsockname())
            time.sleep(0.2)
            link.fall_silent(False)
            time.sleep(0.2)
            far.sendto(b'second', near.getsockname())
            assert near.recv(10) == b'second'
