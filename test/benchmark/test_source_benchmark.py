# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The benchmark of a source counts what it says; how fast it is is the machine's business."""

from argparse import Namespace
import json

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')
av = pytest.importorskip('av')

from node_harness import DOMAINS  # noqa: E402, I100
from sph_stab_ros.benchmark.source import figures, main, sent_frames  # noqa: E402
from sph_stab_ros.evaluation.docs_tables import filled  # noqa: E402

MS = 1_000_000


def test_a_stamp_tells_which_picture_it_is():
    args = Namespace(width=256, rate=20., frames=10)
    # Held up now and then.
    taken_ns = [10**18 + n * 50 * MS + n % 3 * 10 * MS for n in range(sent_frames(args))]
    # The clocks of the stamps differ from the sender's by less than half a period; two are lost,
    # and those before and behind do not count.
    received_ns = {taken + 3 * MS: taken + 30 * MS
                   for n, taken in enumerate(taken_ns) if n not in (62, 65)}
    result = figures(args, taken_ns, received_ns, {})
    assert (result['orientations'], result['views']) == (8, 0)
    assert result['orientations_latency_ms'] == pytest.approx({'p50': 30., 'p95': 30., 'p99': 30.})


@pytest.mark.ros
@pytest.mark.slow
def test_a_short_run(turning_bag, tmp_path, monkeypatch):
    if int(av.__version__.partition('.')[0]) < 17:
        pytest.skip('this PyAV does not give away what RTCP says')
    monkeypatch.setenv('ROS_DOMAIN_ID', str(next(DOMAINS)))
    path = tmp_path / 'figures.json'
    path.write_text('{"other": 1}')
    assert main([str(turning_bag), '--width', '256', '--rate', '20', '--frames', '20', '--view',
                 '--add-to', str(path)]) == 0
    outcome = json.loads(path.read_text())
    assert outcome['other'] == 1
    result = outcome['source_256_view']
    assert 0 < result['orientations'] <= 20 and 0 < result['views'] <= 20
    # Earlier than it was taken no picture can be seen.
    assert result['orientations_latency_ms']['p50'] > 0 and result['views_latency_ms']['p50'] > 0
    assert result['diagnostics']['source_stamps'] == 'sender'
    assert '| 256×128 at 20 Hz, the view as JPEG |' in filled(
        '<!-- source figures -->\n<!-- end -->', tmp_path)


@pytest.mark.parametrize('arguments', (['--frames', '0'], ['--rate', 'nan'], ['--width', '642']))
def test_wrong_calls_are_refused_in_one_line(arguments, capsys):
    with pytest.raises(SystemExit, match='2'):
        main(arguments)
    assert capsys.readouterr().err.count('\n') == 1
