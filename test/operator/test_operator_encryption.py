# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How the operator's page is encrypted: certificates, what is on the wire, who is refused."""

import asyncio
from contextlib import asynccontextmanager
from ipaddress import ip_address
import ssl
import stat

import pytest

aiohttp = pytest.importorskip('aiohttp', reason='aiohttp is not installed')
pytest.importorskip('cryptography', reason='cryptography is not installed')
from cryptography import x509  # noqa: E402, I100
from operator_site import next_picture, site as open_site, TIMEOUT_S  # noqa: E402
from sph_stab_ros.operator import certificate, listening  # noqa: E402
from sph_stab_ros.operator.addresses import is_name, own_addresses, own_names  # noqa: E402
from sph_stab_ros.operator.certificate import own_identity  # noqa: E402
from sph_stab_ros.operator.encryption import context  # noqa: E402

NAMES = {'localhost', 'robot', 'robot.local'}
ADDRESSES = {ip_address(one) for one in ('127.0.0.1', '::1', '192.168.7.3', 'fe80::7')}
SECRET = 'open-sesame-open-sesame'


@pytest.fixture(scope='module')
def identity(tmp_path_factory):
    return own_identity(tmp_path_factory.mktemp('data') / 'operator', NAMES, ADDRESSES)


def trusting(identity):
    """Return the TLS context of a browser that trusts the authority, and nobody else."""
    return ssl.create_default_context(cadata=identity.authority_pem.decode())


class Wire:
    """What lies between browser and server, and sees all that passes."""

    def __init__(self, port):
        self._port = port
        self.seen = bytearray()

    @asynccontextmanager
    async def laid(self):
        """Give the port to connect to."""
        server = await asyncio.start_server(self._carry, '127.0.0.1', 0)
        try:
            yield server.sockets[0].getsockname()[1]
        finally:
            server.close()

    async def _carry(self, reader, writer):
        far_reader, far_writer = await asyncio.open_connection('127.0.0.1', self._port)
        await asyncio.gather(self._copy(reader, far_writer), self._copy(far_reader, writer))

    async def _copy(self, reader, writer):
        try:
            while data := await reader.read(1 << 16):
                self.seen += data
                writer.write(data)
        except ConnectionError:
            pass
        writer.close()


@pytest.mark.parametrize('encrypted', [True, False], ids=['https', 'http'])
def test_the_token_is_on_the_wire_only_without_encryption(identity, encrypted):
    async def run():
        tls = context(identity.file) if encrypted else None
        async with open_site(token=SECRET, tls=tls) as one:
            wire = Wire(one.port)
            async with wire.laid() as one.port:
                one.url = f"http{'s' * encrypted}://localhost:{one.port}"
                one.trusted = trusting(identity)
                assert await one.status(f'/?token={SECRET}') == 200
                browser = await one.connect(f'?token={SECRET}')
                await next_picture(one, browser, 1)
        assert len(wire.seen) > 1000
        for known in (SECRET, 'socket', 'look', 'state', '<main>'):
            assert (known.encode() in wire.seen) == (not encrypted), known
    asyncio.run(asyncio.wait_for(run(), TIMEOUT_S))


def served(identity):
    """Run a test, a coroutine function of a Site with encryption and token."""
    def decorate(test):
        async def run():
            async with open_site(token=SECRET, tls=context(identity.file)) as one:
                one.url, one.trusted = f'https://localhost:{one.port}', trusting(identity)
                await asyncio.wait_for(test(one), TIMEOUT_S)
        asyncio.run(run())
    return decorate


def test_the_token_is_asked_for_all_the_same(identity):
    @served(identity)
    async def _(site):
        assert await site.status('/') == 403
        assert await site.refusal() == 403
        # A page that somebody on the way may have written.
        assert await site.refusal(f'?token={SECRET}',
                                  Origin=f'http://localhost:{site.port}') == 403
        await (await site.connect(f'?token={SECRET}')).receive('state')


@pytest.mark.filterwarnings('ignore::DeprecationWarning')
def test_old_protocols_are_refused(identity):
    """By the server: to another one the same client does talk."""
    def speaking(version, made):
        # What OpenSSL would not even try by itself.
        made.set_ciphers('ALL:@SECLEVEL=0')
        made.minimum_version = made.maximum_version = version
        return made

    for version in (ssl.TLSVersion.TLSv1, ssl.TLSVersion.TLSv1_1):
        old = speaking(version, trusting(identity))
        assert handshake(identity, old, 'localhost', speaking(version, context(
            identity.file))) is None
        with pytest.raises(ssl.SSLError, match='(?i)unsupported.protocol'):
            handshake(identity, old, 'localhost')

        @served(identity)
        async def _(site):
            with pytest.raises((ssl.SSLError, ConnectionError)):
                await asyncio.open_connection('localhost', site.port, ssl=old)

    @served(identity)
    async def _(site):
        for version in (ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3):
            _, writer = await asyncio.open_connection(
                'localhost', site.port, ssl=speaking(version, trusting(identity)))
            writer.close()


def test_who_does_not_encrypt_is_let_go_and_disturbs_nobody(identity, monkeypatch, caplog):
    monkeypatch.setattr(listening, 'HANDSHAKE_S', 0.5)

    @served(identity)
    async def _(site):
        browser = await site.connect(f'?token={SECRET}')
        for said in (f'GET /?token={SECRET} HTTP/1.1\r\nHost: localhost\r\n\r\n'.encode(),
                     b'\x16\x03\x01\x02\x00\x01', b''):
            reader, writer = await asyncio.open_connection('127.0.0.1', site.port)
            writer.write(said)
            try:
                answer = await reader.read()
            except ConnectionError:
                answer = b''
            # At most an alert.
            assert len(answer) < 10 and b'HTTP' not in answer
            writer.close()
        await next_picture(site, browser, 1)
    assert not [one for one in caplog.records if one.exc_info]
    assert SECRET not in caplog.text


@pytest.mark.parametrize('name', ['localhost', '127.0.0.1', 'robot', 'robot.local', '192.168.7.3',
                                  'fe80::7'])
def test_who_trusts_the_authority_trusts_the_machine_s_names(identity, name):
    assert handshake(identity, trusting(identity), name) is None


@pytest.mark.parametrize('name', ['robot.example', '192.168.7.4', 'www.example.com'])
def test_other_names_are_not_its_own(identity, name):
    assert 'mismatch' in handshake(identity, trusting(identity), name)


def test_who_does_not_trust_the_authority_is_warned(identity):
    assert 'issuer' in handshake(identity, ssl.create_default_context(), 'localhost')


def handshake(identity, client, name, server=None):
    """Return why a client does not take the server for the one of a name; None if it does."""
    to_client, to_server = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [client.wrap_bio(to_client, to_server, server_hostname=name),
            (server or context(identity.file)).wrap_bio(to_server, to_client, server_side=True)]
    for _ in range(4):
        for end in ends:
            try:
                end.do_handshake()
            except ssl.SSLWantReadError:
                pass
            except ssl.SSLCertVerificationError as error:
                return error.verify_message.lower()
    return None


@pytest.mark.parametrize('names, addresses', [
    ({'www.example.com'}, {ip_address('127.0.0.1')}), (NAMES, {ip_address('8.8.8.8')})])
def test_a_stolen_authority_vouches_for_nothing_else(identity, tmp_path, names, addresses):
    authority, key = certificate._read(identity.file.with_name(certificate.AUTHORITY))
    leaf, leaf_key = certificate._new_leaf(authority, key, names, addresses)
    certificate._write(tmp_path / 'leaf.pem', leaf, leaf_key)
    forged = certificate.Identity(tmp_path / 'leaf.pem', '', b'', '')
    name = str(next(iter({*names} - NAMES), *addresses))
    assert 'permitted subtree' in handshake(forged, trusting(identity), name)


def test_what_is_kept_is_the_owner_s_alone(identity):
    folder = identity.file.parent
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    files = list(folder.iterdir())
    assert len(files) == 2
    for file in files:
        assert stat.S_IMODE(file.stat().st_mode) == 0o600


def test_the_next_start_finds_it(tmp_path):
    first = own_identity(tmp_path, NAMES, ADDRESSES)
    assert own_identity(tmp_path, NAMES, ADDRESSES) == first
    # Another network: the authority that browsers trust stays.
    moved = own_identity(tmp_path, NAMES, {ip_address('10.0.0.9')})
    assert moved.authority_pem == first.authority_pem
    assert moved.fingerprint != first.fingerprint
    assert handshake(moved, trusting(first), '10.0.0.9') is None
    # An address that the authority has not been made for.
    public = own_identity(tmp_path, NAMES, {ip_address('203.0.113.5')})
    assert public.authority_pem != first.authority_pem
    assert handshake(public, trusting(public), '203.0.113.5') is None


@pytest.mark.parametrize('rest', [1, 29])
def test_a_certificate_that_ends_soon_is_made_anew(tmp_path, monkeypatch, rest):
    first = own_identity(tmp_path, NAMES, ADDRESSES)
    leaf = x509.load_pem_x509_certificate(first.file.read_bytes())
    monkeypatch.setattr(certificate, '_now', lambda: certificate._ends(leaf)
                        - certificate.timedelta(days=rest))
    later = own_identity(tmp_path, NAMES, ADDRESSES)
    assert later.fingerprint != first.fingerprint
    assert later.authority_pem == first.authority_pem


@pytest.mark.parametrize('file', [certificate.AUTHORITY, certificate.LEAF])
@pytest.mark.parametrize('content', [b'', b'nonsense', None], ids=['empty', 'nonsense', 'half'])
def test_damaged_files_are_made_anew(tmp_path, file, content):
    own_identity(tmp_path, NAMES, ADDRESSES)
    path = tmp_path / file
    path.write_bytes(path.read_bytes()[:200] if content is None else content)
    again = own_identity(tmp_path, NAMES, ADDRESSES)
    assert handshake(again, trusting(again), 'localhost') is None


@pytest.mark.parametrize('host, name', [
    ('robot.local', True), ('Robot_7', True), ('r', True), ('3d-printer', True), ('', False),
    ('0.0.0.0', False), ('192.168.0.1', False), ('::1', False), ('(none)', False),
    ('röbot', False), ('-robot', False)])
def test_names_are_told_from_addresses(host, name):
    assert is_name(host) == name


def test_this_machine_s_names_and_addresses():
    assert 'localhost' in own_names()
    assert {ip_address('127.0.0.1'), ip_address('::1')} <= own_addresses()


def test_one_s_own_certificate(identity, tmp_path):
    """In two files; with a key of another it does not go together."""
    leaf, key = tmp_path / 'leaf.pem', tmp_path / 'key.pem'
    text = identity.file.read_text()
    cut = text.index('-----BEGIN PRIVATE KEY')
    leaf.write_text(text[:cut])
    key.write_text(text[cut:])
    assert context(leaf, key)
    other = own_identity(tmp_path / 'other', NAMES, ADDRESSES).file
    for wrong in (leaf, other, tmp_path / 'nothing'):
        with pytest.raises(OSError):
            context(leaf, wrong)
