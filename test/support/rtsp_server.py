# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
A small RTSP server (RFC 2326) for one client at a time: RTP by FFmpeg, interleaved with TCP.

It passes on what FFmpeg's own muxer sends by datagrams, reports of the sender's clock included.
"""

from contextlib import contextmanager
import select
import socket
from struct import pack
from threading import Thread

from live_sender import sending

SDP = ('v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=test\r\nc=IN IP4 127.0.0.1\r\nt=0 0\r\n'
       'm=video 0 RTP/AVP 96\r\na=rtpmap:96 H264/90000\r\n'
       'a=fmtp:96 packetization-mode=1\r\na=control:track\r\n')
LARGEST = 65536
REPORTS = 1


class RtspServer:
    """Serves what comes to a pair of ports by ``rtp://``; ``url`` is where."""

    def __init__(self, port=0):
        self.datagrams = datagram_pair()
        self._listener = socket.create_server(('127.0.0.1', port))
        self.url = 'rtsp://{}:{}/sphere'.format(*self._listener.getsockname())
        self._client = None
        self._is_playing = False
        self._report = b''
        self._thread = Thread(target=self._serve, daemon=True)

    def start(self):
        self._thread.start()

    def close(self):
        for one in (self._listener, self._client, *self.datagrams):
            if one:
                one.close()
        self._thread.join()

    def _serve(self):
        try:
            while True:
                ends = [one for one in (self._listener, self._client, *self.datagrams) if one]
                for end in select.select(ends, (), (), 0.2)[0]:
                    self._hear(end)
        except (OSError, ValueError):
            # It has been closed.
            return

    def _hear(self, end):
        if end is self._listener:
            self._client, self._is_playing = end.accept()[0], False
        elif end is self._client:
            request = end.recv(LARGEST)
            if request:
                self._answer(request.decode(errors='replace'))
            else:
                self._hang_up()
        else:
            channel = self.datagrams.index(end)
            data = end.recv(LARGEST)
            packet = pack('>cBH', b'$', channel, len(data)) + data
            if channel == REPORTS:
                self._report = packet
            self._pass_on(packet)

    def _pass_on(self, packet):
        if self._is_playing:
            try:
                self._client.sendall(packet)
            except OSError:
                self._hang_up()

    def _hang_up(self):
        self._client.close()
        self._client, self._is_playing = None, False

    def _answer(self, request):
        if request.startswith('$'):
            # Reports of the receiver.
            return
        method = request.split()[0]
        number = request.lower().partition('cseq:')[2].split()[0]
        fields, body = '', ''
        if method == 'OPTIONS':
            fields = 'Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n'
        elif method == 'DESCRIBE':
            body = SDP
            fields = f'Content-Type: application/sdp\r\nContent-Length: {len(body)}\r\n'
        elif method == 'SETUP':
            fields = 'Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1\r\n'
        elif method == 'PLAY':
            fields = 'Session: 1\r\n'
        self._client.sendall(f'RTSP/1.0 200 OK\r\nCSeq: {number}\r\n{fields}\r\n{body}'.encode())
        if method == 'PLAY':
            self._is_playing = True
            # Who comes later than it was sent need not wait for the next one.
            self._pass_on(self._report)


def datagram_pair():
    """Return sockets of two ports, the first of which is even."""
    while True:
        first, second = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        first.bind(('127.0.0.1', 0))
        port = first.getsockname()[1]
        try:
            if port % 2 == 0:
                second.bind(('127.0.0.1', port + 1))
                return first, second
        except OSError:
            pass
        first.close()
        second.close()


@contextmanager
def rtsp_server(port=0, **sender):
    """Serve the pictures of a live_sender, on any port; give the address."""
    server = RtspServer(port)
    server.start()
    port = server.datagrams[0].getsockname()[1]
    try:
        with sending(f'rtp://127.0.0.1:{port}?pkt_size=1400', 'rtp', **sender):
            yield server.url
    finally:
        server.close()
