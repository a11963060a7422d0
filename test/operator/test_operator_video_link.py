# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The operator's video over a radio that is slow, loses packets, or falls silent."""

import time

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')
pytest.importorskip('aiohttp', reason='aiohttp is not installed')
pytest.importorskip('av', reason='PyAV is not installed')
pytest.importorskip('cryptography', reason='cryptography is not installed')
from bad_link import BadLink, why_not  # noqa: E402, I100
from operator_harness import chromium, Page, wait_until  # noqa: E402
from operator_served import Served  # noqa: E402
from operator_site import striped_jpeg  # noqa: E402
from sph_stab_ros.operator.certificate import own_identity  # noqa: E402
from sph_stab_ros.operator.encryption import context  # noqa: E402
from sph_stab_ros.operator.video import Video  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(why_not()), reason=why_not())]
TOKEN = 'sesame'


@pytest.fixture(scope='module')
def link():
    with BadLink() as link:
        yield link


@pytest.fixture(scope='module')
def browser(link):
    """Return a browser at the far end of the link."""
    with link.inside():
        starting = chromium()
        browser = starting.__enter__()
    yield browser
    starting.__exit__(None, None, None)


@pytest.fixture(params=['websocket', 'datagrams'])
def page(link, browser, tmp_path, request):
    """Return the page as it shows a film by https, one way or the other."""
    def warn(kind, text):
        pass

    ways = {}
    if request.param == 'datagrams':
        pytest.importorskip('aioquic', reason='aioquic is not installed')
        from sph_stab_ros.operator.datagrams import Datagrams
        ways = {'datagrams': Datagrams(warn)}
    identity = own_identity(tmp_path, {'localhost'}, set())
    with Served(token=TOKEN, tls=context(identity.file), host=link.near, video=Video(warn),
                **ways) as served:
        served.file = striped_jpeg(height=480)
        page = Page(browser, f'https://{link.near}:{served.port}/?token={TOKEN}',
                    ignore_https_errors=True)
        page.wait_for_situation('stabilized')
        client, = served.server._browsers
        wait_until(lambda: bool(client.datagrams) == bool(ways), page.situation)
        yield page
        link.fall_silent(False)
        page.context.close()
        assert not page.errors


def what(page):
    """Return what pictures come as."""
    return page.page.text_content('[data-figure=what]')


def test_the_film_goes_on_after_an_outage(link, page):
    """Whether of a moment or so long that the page gives the connection up."""
    wait_until(lambda: 'H.264' in what(page), page.situation)
    for seconds in (0.5, 2, 6):
        link.fall_silent()
        time.sleep(seconds)
        last_ns = page.stamp_ns
        link.fall_silent(False)
        page.wait_for_picture_after(last_ns)
        page.wait_for_situation('stabilized')
        wait_until(lambda: not page.page.is_visible('#control'), page.situation)
        wait_until(lambda: 'H.264' in what(page), page.situation)
