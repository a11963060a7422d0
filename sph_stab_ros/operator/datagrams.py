# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Pictures of a video by datagrams: WebTransport, that is HTTP/3 over QUIC.

Beside a browser's WebSocket, which stays for all else and tells the browser how to get here. What
a lost packet had in it does not hold up what comes behind: see ``error_correction``.
"""

import asyncio
from base64 import b64encode
from collections.abc import Callable
import logging
import secrets
from time import monotonic
from typing import Any

from aioquic.asyncio.protocol import QuicConnectionProtocol
from aioquic.asyncio.server import QuicServer
from aioquic.h3.connection import H3_ALPN, H3Connection
from aioquic.h3.events import DatagramReceived, DataReceived, H3Event, HeadersReceived
from aioquic.quic.configuration import QuicConfiguration
from aioquic.quic.congestion.base import QuicCongestionControl, register_congestion_control
from aioquic.quic.connection import QuicConnection
from aioquic.quic.events import ConnectionTerminated, QuicEvent
from cryptography.hazmat.primitives import hashes

from sph_stab_ros.operator.certificate import new_brief_identity
from sph_stab_ros.operator.client import Client
from sph_stab_ros.operator.error_correction import group_pieces, pieces
from sph_stab_ros.operator.listening import Allowance, BURST_BYTES, BYTES_PER_S
from sph_stab_ros.operator.protocol import (
    Arrived, Command, Drawn, parse_command, ProtocolError)

PATH = '/datagrams/'
SECRET_BYTES = 16
# Browsers trust a certificate by its hash for 14 days at most (W3C); this is how long one is told.
CERTIFICATE_S = 5 * 24 * 3600.
# A connection that is no browser's by then is closed.
PATIENCE_S = 5.
# A way without any packet for so long is given up, at both ends.
IDLE_S = 5.
# First packets of connections, of which a browser needs some ten; they may cost a signature.
FIRST_PER_S, FIRST_BURST = 50., 200.
LONG_HEADER = 0x80
# With more of it not acknowledged, packet by packet, a browser has to go.
MAX_IN_FLIGHT_BYTES = 1 << 20
UNHURRIED = 'sph_stab_ros'
# How many packets tell what share of them gets lost.
LOSS_PACKETS = 500


class RateIsElsewhere(QuicCongestionControl):
    """
    Sends what there is to send: how much that is RateControl decides, by how late pictures are.

    QUIC's own ways take every lost packet for a sign of a crowded link. ``loss`` is the share of
    packets that get lost, lately.
    """

    loss = 0.

    def __init__(self, *, max_datagram_size: int) -> None:
        super().__init__(max_datagram_size=max_datagram_size)
        self.congestion_window = 2 * MAX_IN_FLIGHT_BYTES

    def on_packet_sent(self, *, packet: Any) -> None:
        """Count what is on its way."""
        self.bytes_in_flight += packet.sent_bytes

    def on_packet_acked(self, *, now: float, packet: Any) -> None:
        """Count what is on its way, and what gets lost."""
        self.bytes_in_flight -= packet.sent_bytes
        self.loss -= self.loss / LOSS_PACKETS

    def on_packets_expired(self, *, packets: Any) -> None:
        """Count what is on its way."""
        self.bytes_in_flight -= sum(packet.sent_bytes for packet in packets)

    def on_packets_lost(self, *, now: float, packets: Any) -> None:
        """Count what is on its way, and what gets lost."""
        for packet in packets:
            self.bytes_in_flight -= packet.sent_bytes
            self.loss += (1 - self.loss) / LOSS_PACKETS

    def on_persistent_congestion(self) -> None:
        """Do nothing."""

    def on_rtt_measurement(self, *, now: float, rtt: float) -> None:
        """Do nothing."""


register_congestion_control(UNHURRIED, RateIsElsewhere)
# It has a line for each connection, and for much of what strangers send.
logging.getLogger('quic').setLevel(logging.CRITICAL)


class Session(QuicConnectionProtocol):
    """A connection, which becomes a browser's by its secret. For the event loop's thread."""

    def __init__(self, quic: QuicConnection, owner: 'Datagrams') -> None:
        super().__init__(quic)
        self._owner = owner
        self._http: H3Connection | None = None
        self._stream = 0
        self._client: Client | None = None
        self._allowance = Allowance(BYTES_PER_S, BURST_BYTES)
        self._last = 0
        self._loop.call_later(PATIENCE_S, self._check)

    def datagram_received(self, data: Any, addr: Any) -> None:
        """Take in a packet, as long as they are not too many."""
        if self._allowance.take(len(data)):
            super().datagram_received(data, addr)
        else:
            self.drop('too much data')

    def quic_event_received(self, event: QuicEvent) -> None:
        """Take in what has happened."""
        if isinstance(event, ConnectionTerminated):
            self._end()
        elif self._http is None:
            self._http = H3Connection(self._quic, enable_webtransport=True)
        if self._http:
            for http_event in self._http.handle_event(event):
                self._take(http_event)

    def send(self, sequence: int, message: bytes, is_key: bool) -> None:
        """Send a picture; one that is no key picture needs the one before."""
        control = self._quic._loss._cc
        assert self._http is not None and isinstance(control, RateIsElsewhere)
        if control.bytes_in_flight > MAX_IN_FLIGHT_BYTES:
            self.drop('no answer')
            return
        for piece in pieces(sequence, 0 if is_key else self._last, message,
                            group_pieces(control.loss)):
            self._http.send_datagram(self._stream, piece)
        self._last = sequence
        self.transmit()

    def drop(self, reason: str) -> None:
        """End, with a line in the log."""
        self._owner.warn('dropped', f'{self._client.name if self._client else "a connection"} '
                                    f'dropped (datagrams): {reason}')
        self.close()

    def close(self, *args: Any, **kwargs: Any) -> None:
        """End."""
        self._end()
        super().close(*args, **kwargs)

    def _check(self) -> None:
        if self._client is None:
            super().close()

    def _end(self) -> None:
        client, self._client = self._client, None
        if client and client.datagrams is self:
            client.take_way(None)

    def _take(self, event: H3Event) -> None:
        if isinstance(event, HeadersReceived) and self._client is None:
            self._admit(event)
        elif isinstance(event, DatagramReceived) and self._client:
            self._hear(self._client, event.data)
        elif isinstance(event, DataReceived) and event.stream_ended:
            self.close()

    def _admit(self, event: HeadersReceived) -> None:
        assert self._http is not None
        headers = dict(event.headers)
        client = self._owner.admitted(headers)
        self._http.send_headers(event.stream_id, [
            (b':status', b'200' if client else b'403'),
            (b'sec-webtransport-http3-draft', b'draft02')], end_stream=client is None)
        self.transmit()
        if client:
            self._client, self._stream = client, event.stream_id
            client.take_way(self)

    def _hear(self, client: Client, data: bytes) -> None:
        try:
            if not client.may_speak():
                raise ProtocolError('too many messages')
            command = parse_command(data.decode(errors='replace'))
            # Only what may get lost, or come late.
            if not isinstance(command, (Drawn, Arrived)):
                raise ProtocolError('no message for a datagram')
        except ProtocolError as error:
            self.drop(str(error))
        else:
            self._owner.obey(client, command)


class Door(asyncio.DatagramProtocol):
    """Passes packets on to QUIC, but not too many first ones, and none that it fails at."""

    def __init__(self, inner: QuicServer, warn: Callable[[str, str], object]) -> None:
        self._inner, self._warn = inner, warn
        self._first = Allowance(FIRST_PER_S, FIRST_BURST)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin."""
        self._inner.connection_made(transport)

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Pass a packet on."""
        if data and data[0] & LONG_HEADER and not self._first.take():
            self._warn('packets', f'{addr[0]}: a packet left out, too many connections begin')
            return
        try:
            self._inner.datagram_received(data, addr)
        except Exception as error:  # noqa: B902
            # Whatever strangers send must not end up as a traceback for each packet.
            self._warn('packets', f'{addr[0]}: a packet left out: {error!r}')

    def close(self) -> None:
        """End all connections."""
        self._inner.close()


class Datagrams:
    """
    Listens for connections, and lets in those that know a secret, each once.

    Parameters
    ----------
    warn
        Logs a text; the kind of event comes before it.

    """

    def __init__(self, warn: Callable[[str, str], object]) -> None:
        self.warn = warn
        self.obey: Callable[[Client, Command], object] = lambda client, command: None
        self._doors: list[Door] = []
        self._invited: dict[str, Client] = {}
        self._configuration = QuicConfiguration(
            alpn_protocols=H3_ALPN, is_client=False, idle_timeout=IDLE_S,
            max_datagram_frame_size=1 << 16, congestion_control_algorithm=UNHURRIED)
        self._renew()

    async def start(self, addresses: list[Any], obey: Callable[[Client, Command], object]) -> None:
        """Listen at addresses of the web server; OSError where that cannot be."""
        self.obey = obey
        loop = asyncio.get_running_loop()
        for address in addresses:
            _, door = await loop.create_datagram_endpoint(
                lambda: Door(QuicServer(
                    configuration=self._configuration, retry=True,
                    create_protocol=lambda quic, stream_handler: Session(quic, self)), self.warn),
                local_addr=address[:2])
            self._doors.append(door)

    def close(self) -> None:
        """End."""
        for door in self._doors:
            door.close()
        self._doors.clear()

    def invite(self, client: Client) -> dict[str, str]:
        """Return what a browser has to be told to come."""
        if monotonic() > self._renew_s:
            self._renew()
        path = PATH + secrets.token_urlsafe(SECRET_BYTES)
        self._invited[path] = client
        return {'path': path, 'sha256': self._sha256}

    def dismiss(self, client: Client) -> None:
        """Let a browser go."""
        self._invited = {path: one for path, one in self._invited.items() if one is not client}
        if client.datagrams:
            client.datagrams.close()

    def admitted(self, headers: dict[bytes, bytes]) -> Client | None:
        """Return whose a request is, which is so once; None where it is nobody's."""
        if headers.get(b':protocol') != b'webtransport' \
                or headers.get(b'origin') != b'https://' + headers.get(b':authority', b''):
            return None
        return self._invited.pop(headers.get(b':path', b'').decode(errors='replace'), None)

    def _renew(self) -> None:
        """Have a certificate that is new; connections that there are keep theirs."""
        certificate, key = new_brief_identity()
        self._configuration.certificate, self._configuration.private_key = certificate, key
        self._sha256 = b64encode(certificate.fingerprint(hashes.SHA256())).decode()
        self._renew_s = monotonic() + CERTIFICATE_S
