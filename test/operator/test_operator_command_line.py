# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The operator's command line, by what it prints and whom it lets in."""

import asyncio
from contextlib import contextmanager
import hashlib
import os
import re
import signal
import socket
import ssl
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')
aiohttp = pytest.importorskip('aiohttp', reason='aiohttp is not installed')
pytest.importorskip('cryptography', reason='cryptography is not installed')
from node_harness import DOMAINS  # noqa: E402, I100
from sph_stab_ros.operator.addresses import own_addresses  # noqa: E402
from sph_stab_ros.operator.certificate import own_identity  # noqa: E402

TIMEOUT_S = 30.
AUTHORITY = 'authority.crt'
FINGERPRINT = r'((?:[0-9A-F]{2}:){31}[0-9A-F]{2})'


def operator(data, *arguments, code=None):
    """Start the server, with a user's data folder of its own."""
    program = ['-c', code] if code else ['-m', 'sph_stab_ros.operator']
    return subprocess.Popen(
        [sys.executable, *program, '--port', '0', *arguments], text=True,
        env={**os.environ, 'ROS_DOMAIN_ID': str(next(DOMAINS)), 'XDG_DATA_HOME': str(data)},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE)


@contextmanager
def running(data, *arguments, lines=1):
    """Give what the server prints at its start, some lines; what it logs has no token in it."""
    server = operator(data, *arguments)
    said = ''
    try:
        said = ''.join(server.stdout.readline() for _ in range(lines))
        yield said
    finally:
        server.send_signal(signal.SIGTERM)
        rest, errors = server.communicate(timeout=TIMEOUT_S)
    assert server.returncode == 0 and not rest, errors
    token = re.search(r'token=([\w-]+)', said)
    assert not token or token.group(1) not in errors


def fetched(url, trusted=None):
    """Return status and body of an answer; without anybody trusted, whoever it is from."""
    async def fetch():
        async with aiohttp.ClientSession() as session, session.get(
                url, ssl=trusted or False) as answer:
            return answer.status, await answer.read()
    return asyncio.run(fetch())


def sha256(pem):
    """Return the fingerprint of a certificate."""
    digest = hashlib.sha256(ssl.PEM_cert_to_DER_cert(pem)).hexdigest().upper()
    return ':'.join(digest[n:n + 2] for n in range(0, 64, 2))


def test_beyond_this_machine_there_is_encryption_and_a_token(tmp_path):
    printed, reached = [], []
    for _ in range(2):
        reached.append(own_addresses())
        with running(tmp_path, '--host', '0.0.0.0', lines=3) as said:
            port, token = re.match(
                r'operator: https://[^/]+:(\d+)/\?token=([\w-]{20,})\n', said).groups()
            own, authority = re.findall(FINGERPRINT, said)
            url = f'https://localhost:{port}/'
            # As a phone does that trusts nobody yet: then it compares.
            status, body = fetched(url + AUTHORITY)
            assert status == 200 and sha256(body.decode()) == authority
            assert sha256(ssl.get_server_certificate(('127.0.0.1', int(port)))) == own
            trusted = ssl.create_default_context(cadata=body.decode())
            statuses = [fetched(url + query, trusted)[0]
                        for query in ('', '?token=', f'?token={token}')]
            assert statuses == [403, 403, 200]
            with pytest.raises(aiohttp.ClientError):
                fetched(f'http://127.0.0.1:{port}/?token={token}')
            printed.append((own, authority, token))
    # The next start is trusted too, and has another token.
    (own, authority, token), (own_again, authority_again, token_again) = printed
    assert authority == authority_again and token != token_again
    # Others here may add interfaces meanwhile.
    assert own == own_again or reached[0] != reached[1]


def test_insecure_is_http_with_a_token(tmp_path):
    with running(tmp_path, '--host', '0.0.0.0', '--insecure') as said:
        port, token = re.fullmatch(
            r'operator: http://[^/]+:(\d+)/\?token=([\w-]{20,})\n', said).groups()
        url = f'http://127.0.0.1:{port}/'
        assert [fetched(url + query)[0] for query in ('', f'?token={token}', AUTHORITY)] == [
            403, 200, 404]
    assert not list(tmp_path.iterdir())


def test_one_s_own_certificate(tmp_path):
    identity = own_identity(tmp_path / 'mine', {'localhost'}, set())
    with running(tmp_path / 'data', '--certificate', str(identity.file)) as said:
        url, = re.fullmatch(r'operator: (https://127\.0\.0\.1:\d+/)\n', said).groups()
        trusted = ssl.create_default_context(cadata=identity.authority_pem.decode())
        assert fetched(url.replace('127.0.0.1', 'localhost'), trusted)[0] == 200
        assert fetched(url + AUTHORITY)[0] == 404
    assert not (tmp_path / 'data').exists()


def said_and_failed(server):
    """Return the one line that a server leaves which cannot start."""
    output, errors = server.communicate(timeout=TIMEOUT_S)
    assert server.returncode == 1 and not output
    assert re.fullmatch('operator: .+\n', errors), errors
    return errors


def test_certificates_that_are_of_no_use(tmp_path):
    nonsense = tmp_path / 'nonsense.pem'
    nonsense.write_text('nonsense')
    for path, said in ((nonsense, 'no certificate'), (tmp_path / 'none', 'No such file')):
        errors = said_and_failed(operator(tmp_path, '--certificate', str(path)))
        assert said in errors and str(path) in errors
    # A folder that cannot be.
    assert '/dev/null' in said_and_failed(operator('/dev/null', '--host', '0.0.0.0'))


def test_without_cryptography(tmp_path):
    code = ('import sys; sys.modules["cryptography"] = None\n'
            'from sph_stab_ros.operator.__main__ import main\n'
            'sys.exit(main(sys.argv[1:]))')
    errors = said_and_failed(operator(tmp_path, '--host', '0.0.0.0', code=code))
    assert 'cryptography' in errors and '--insecure' in errors


def test_the_port_is_taken(tmp_path):
    with socket.socket() as other:
        other.bind(('127.0.0.1', 0))
        other.listen()
        server = operator(tmp_path, '--port', str(other.getsockname()[1]))
        assert 'cannot listen on 127.0.0.1: ' in said_and_failed(server)
