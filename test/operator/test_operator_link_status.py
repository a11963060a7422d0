# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""What /diagnostics says of the browsers' links: as the page shows it."""

import asyncio
import json
import os
import signal
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')
aiohttp = pytest.importorskip('aiohttp', reason='aiohttp is not installed')
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402, I100
from node_harness import DOMAINS, leave  # noqa: E402
from operator_harness import TIMEOUT_S, wait_until  # noqa: E402
from operator_served import Served  # noqa: E402
import rclpy  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from sph_stab_ros.operator.link_status import link_status  # noqa: E402
from sph_stab_ros.operator.protocol import Link  # noqa: E402
from sph_stab_ros.operator.robot_interface import Watcher  # noqa: E402

FIGURES = {'drawn': 29.5, 'dropped': 0.5, 'mbit_s': 3.21, 'latency_ms': 80.4,
           'latency_p95_ms': 134, 'round_trip_ms': None}
SHOWN = {'drawn_hz': '29.5', 'dropped_hz': '0.5', 'received_mbit_s': '3.2', 'latency_ms': '80.4',
         'latency_p95_ms': '134.0'}


def test_each_browser_has_its_figures():
    message, values = link_status([
        Watcher('10.0.0.2', False, None), Watcher('10.0.0.3', True, Link(**FIGURES))])
    assert message == '2 browsers'
    assert values == {
        'browsers': '2', 'browser 1': '10.0.0.2', 'browser 2': '10.0.0.3, steers',
        **{f'browser 2: {key}': value for key, value in SHOWN.items()}}


def test_nobody_watches():
    assert link_status([]) == ('nobody watches', {'browsers': '0'})


@pytest.mark.slow
def test_the_figures_come_over_the_middleware():
    domain = next(DOMAINS)
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node('watcher', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    seen = []
    node.create_subscription(
        DiagnosticArray, '/diagnostics', lambda msg: seen.extend(msg.status), 10)
    server = subprocess.Popen(
        [sys.executable, '-m', 'sph_stab_ros.operator', '--port', '0'], text=True,
        env={**os.environ, 'ROS_DOMAIN_ID': str(domain)}, stdout=subprocess.PIPE)
    url = server.stdout.readline().split()[-1]

    async def watch():
        async with aiohttp.ClientSession() as session, session.ws_connect(
                url + 'socket', headers={'Origin': url.rstrip('/')}) as browser:
            await browser.send_str(json.dumps({'type': 'link', **FIGURES}))
            while not any(len(status.values) > 2 for status in seen):
                executor.spin_once(timeout_sec=0)
                await asyncio.sleep(0.02)

    try:
        asyncio.run(asyncio.wait_for(watch(), TIMEOUT_S))
    finally:
        server.send_signal(signal.SIGINT)
        assert server.wait(TIMEOUT_S) == 0
        leave(node, executor)
    status = seen[-1]
    assert (status.name, status.level) == ('/operator: link', DiagnosticStatus.OK)
    assert {pair.key: pair.value for pair in status.values} == {
        'browsers': '1', 'browser 1': '127.0.0.1, steers',
        **{f'browser 1: {key}': value for key, value in SHOWN.items()}}


# Notes what the page tells of its link, and what it shows then.
PROBE = """() => {
    const {send} = WebSocket.prototype;
    window.told = [];
    WebSocket.prototype.send = function (text) {
        const {type, ...figures} = JSON.parse(text);
        if (type === 'link') setTimeout(() => {
            const shown = name => document.querySelector(`[data-figure=${name}]`).textContent;
            window.told.push([figures, Object.fromEntries(
                Object.keys(figures).map(name => [name, shown(name)]))]);
        });
        return send.call(this, text);
    };
}"""


def test_the_page_tells_what_it_shows(opened):
    with Served() as served:
        page = opened(served.url)
        page.wait_for_situation('stabilized')
        page.page.evaluate(PROBE)

        def known():
            """Return what the robot was told, once the page knows all and the robot that."""
            told = page.page.evaluate('window.told')
            return [(figures, shown) for figures, shown in told for watcher in
                    served.robot.watchers if watcher.link == Link(**figures)
                    and figures['drawn'] and figures['mbit_s'] and figures['round_trip_ms']]

        figures, shown = wait_until(known)[0]
        watcher, = served.robot.watchers
        assert watcher.steers
    assert shown['drawn'] == f"{int(figures['drawn'] + 0.5)} /s"
    assert shown['dropped'] == f"{int(figures['dropped'] + 0.5)} /s"
    assert shown['round_trip_ms'] == f"{int(figures['round_trip_ms'] + 0.5)} ms"
    # Of these stamps no clock tells how old they are.
    assert figures['latency_p95_ms'] is None
    assert shown['latency_p95_ms'] == '–'
