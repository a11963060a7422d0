# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The operator's page when its connection, its server or its pictures are not what they were."""

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')
pytest.importorskip('aiohttp', reason='aiohttp is not installed')
from operator_harness import wait_until  # noqa: E402, I100
from operator_served import Served, Way  # noqa: E402


def test_a_connection_that_falls_silent_is_given_up(opened):
    """Nobody closes it; who steered does so again once the way is free."""
    with Served() as served, Way(served.port) as way:
        page = opened(f'http://127.0.0.1:{way.port}/')
        page.wait_for_situation('stabilized')
        wait_until(lambda: not page.page.is_visible('#control'))
        way.silent = True
        page.wait_for_situation('offline')
        assert page.page.get_by_role('alert').is_visible()
        assert 'No connection' in page.page.inner_text('#alarm')
        last_ns = page.stamp_ns
        page.page.keyboard.press('r')
        assert page.page.inner_text('#notice') == 'No connection.'
        way.silent = False
        page.wait_for_situation('stabilized')
        page.wait_for_picture_after(last_ns)
        wait_until(lambda: not page.page.is_visible('#control'))


def test_a_page_that_is_held_up_keeps_its_connection(opened):
    """It has not listened meanwhile: that is no silence of the server's."""
    with Served() as served:
        page = opened(served.url)
        page.wait_for_situation('stabilized')
        sockets = []
        page.page.on('websocket', lambda socket: sockets.append(socket))
        page.page.evaluate(
            '() => { const end = Date.now() + 5000; while (Date.now() < end) {} }')
        page.wait_for_picture_after(page.stamp_ns)
        page.wait_for_situation('stabilized')
        assert not sockets


def test_an_address_that_is_no_longer_valid(opened):
    """A server that was started again has another token."""
    with Served(token='first') as first, Served(token='second') as second, \
            Way(first.port) as way:
        page = opened(f'http://127.0.0.1:{way.port}/?token=first')
        page.wait_for_situation('stabilized')
        way.to_port, way.silent = second.port, True
        page.wait_for_situation('offline')
        way.silent = False
        wait_until(lambda: 'The address has changed' in page.page.inner_text('#alarm'),
                   page.situation)
        assert page.page.get_attribute('html', 'data-situation') == 'offline'


def test_broken_pictures_do_not_count(opened):
    with Served() as served:
        served.file = b'\xff\xd8 no picture'
        page = opened(served.url)
        page.wait_for_situation('unable')
        wait_until(lambda: page.page.inner_text('#rate') == '0 /s', page.situation)
        sent = []
        # Though they come, and go on to come.
        page.page.on('websocket', lambda socket: socket.on(
            'framesent', lambda frame: sent.append(str(frame))))
        page.page.reload()
        page.wait_for_situation('unable')
        wait_until(lambda: page.page.inner_text('#rate') == '0 /s'
                   and sum('skipped' in one for one in sent) > 10, page.situation)


def test_the_page_is_secure_with_our_own_certificate(opened, tmp_path):
    """So that the browser offers what it keeps back from pages that anybody may have written."""
    pytest.importorskip('cryptography', reason='cryptography is not installed')
    from sph_stab_ros.operator.certificate import own_identity
    from sph_stab_ros.operator.encryption import context
    identity = own_identity(tmp_path, {'localhost'}, set())
    with Served(token='sesame', tls=context(identity.file)) as served:
        # As if somebody had said: go on to this page.
        page = opened(f'https://localhost:{served.port}/?token=sesame', ignore_https_errors=True)
        page.wait_for_situation('stabilized')
        page.wait_for_picture_after(page.stamp_ns)
        assert page.page.evaluate('isSecureContext')
        assert {url.split(':')[0] for url in page.requests} == {'https'}
