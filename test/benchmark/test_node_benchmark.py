# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The end-to-end benchmark counts what it says; how fast it is is the machine's business."""

import json
import math
import os
from pathlib import Path
from xml.etree import ElementTree

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')

from node_harness import DOMAINS  # noqa: E402, I100
from sph_stab_ros.benchmark.node import figures, Heard, main, percentiles  # noqa: E402
from sph_stab_ros.benchmark.node_scenario import MemoryRecording, Scenario  # noqa: E402
from sph_stab_ros.evaluation.docs_tables import filled  # noqa: E402

PROFILE = Path(__file__).resolve().parents[2] / 'config' / 'fastdds_large_images.xml'
KEYS = {'orientations', 'images', 'latency_ms', 'cpu_percent', 'drops'}


@pytest.fixture
def scenario(turning_bag):
    return Scenario(turning_bag, 256, 20., 30, 'stabilized/image', 'raw', '')


def test_figures_count_what_was_heard_once_the_ends_have_found_each_other(scenario):
    sent_ns = scenario.stamps_ns(10**9)
    # The subscriber hears orientations from the 10th picture on, images from the 15th on: the next
    # 20 are warming up, and 30 count. Of these one orientation and two images are lost.
    heard = Heard(orientations={one: one + 5 * 10**6 for one in sent_ns[10:]},
                  images={one: one + k * 10**6 for k, one in enumerate(sent_ns[15:])},
                  diagnostics={'frames': '120', 'dropped': '7', 'not_drawn': '2', 'refused': '0'},
                  cpu_percent={'node': 50.})
    del heard.orientations[sent_ns[40]], heard.images[sent_ns[40]], heard.images[sent_ns[64]]
    result = figures(scenario, sent_ns, heard)
    assert (result['frames'], result['orientations'], result['images']) == (30, 29, 28)
    assert result['latency_ms']['p50'] == pytest.approx(34.5) and result['drops'] == 7
    assert result['orientation_latency_ms'] == {'p50': 5., 'p95': 5., 'p99': 5.}
    assert result['lost'] == {
        'before_counting': 35, 'player_to_node': len(sent_ns) - 127, 'dropped_by_node': 7,
        'not_drawn_by_node': 2, 'orientations_to_subscriber': 120 - len(heard.orientations),
        'images_to_subscriber': 118 - len(heard.images)}


def test_where_nobody_wants_pictures_none_are_missed(turning_bag):
    scenario = Scenario(turning_bag, 3840, 20., 30, 'orientation', 'compressed', 'profile.xml')
    assert scenario.name == 'compressed, profile, 3840 columns, no pictures'
    sent_ns = scenario.stamps_ns(10**9)
    heard = Heard(orientations={one: one + 10**6 for one in sent_ns},
                  diagnostics={'frames': str(len(sent_ns)), 'dropped': '0', 'not_drawn': '0',
                               'refused': '0'})
    result = figures(scenario, sent_ns, heard)
    assert (result['frames'], result['orientations'], result['images']) == (30, 30, 0)
    assert set(result['lost'].values()) == {20, 0} and result['latency_ms'] == {}


def test_nothing_heard_is_all_lost(scenario):
    none = {'frames': '0', 'dropped': '0', 'not_drawn': '0', 'refused': '0'}
    result = figures(scenario, scenario.stamps_ns(10**9), Heard(diagnostics=none))
    assert (result['frames'], result['orientations'], result['images']) == (30, 0, 0)


def test_percentiles_lie_within_and_are_in_order():
    values = percentiles(list(range(101)))
    assert values == {'p50': 50., 'p95': 95., 'p99': 99.}
    assert percentiles([]) == {}


def test_pictures_are_due_evenly_and_stamped_so(scenario):
    recording = MemoryRecording(scenario)
    sent = [(time_ns, msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec, msg.width)
            for time_ns, msg in recording.messages('image')]
    assert [one for one, *_ in sent] == scenario.stamps_ns(recording.start_ns)
    assert all(time_ns == stamp_ns and width == 256 for time_ns, stamp_ns, width in sent)
    # A second before those that count, and four more to spare.
    assert len(sent) == 20 + 30 + 80 and sent[1][0] - sent[0][0] == 5 * 10**7


def test_the_profile_names_a_large_segment():
    space = '{http://www.eprosima.com}'
    profiles = ElementTree.parse(PROFILE).getroot()
    sizes = [int(one.text) for one in profiles.iter(f'{space}segment_size')]
    declared = {one.text for one in profiles.iter(f'{space}transport_id')}
    used = {one.text for one in profiles.find(f'.//{space}userTransports')}
    assert sizes == [64 * 2**20] and used == declared


@pytest.mark.ros
@pytest.mark.slow
def test_a_short_run_with_and_without_profile(turning_bag, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv('ROS_DOMAIN_ID', str(next(DOMAINS)))
    path = tmp_path / 'figures.json'
    assert main([str(turning_bag), '--width', '256', '--rate', '20', '--frames', '20',
                 '--transports', 'raw', '--profile', str(PROFILE), '--json', str(path)]) == 0
    outcome = json.loads(path.read_text())
    assert list(outcome['scenarios']) == [
        'raw, profile, 256 columns', 'raw, defaults, 256 columns']
    for one in (outcome, *outcome['scenarios'].values()):
        assert KEYS <= one.keys()
        assert 0 < one['images'] <= one['orientations'] <= one['frames'] == 20
        latencies = [one['latency_ms'][name] for name in ('p50', 'p95', 'p99')]
        assert 0 < latencies[0] and latencies == sorted(latencies)
        assert all(math.isfinite(percent) and percent > 0
                   for percent in one['cpu_percent'].values())
    assert 'raw, defaults, 256 columns' in capsys.readouterr().out
    assert main([str(turning_bag), '--width', '256', '--rate', '20', '--frames', '20',
                 '--transports', 'raw', '--output', 'orientation', '--add-to', str(path)]) == 0
    added = json.loads(path.read_text())
    alone = added['scenarios'].pop('raw, defaults, 256 columns, no pictures')
    assert added == outcome
    assert 0 < alone['orientations'] <= 20 and not alone['images']
    page = filled('<!-- node figures -->\n<!-- end -->', tmp_path)
    assert '| raw, defaults, 256 columns |' in page


@pytest.mark.parametrize('arguments', (
    ['--profile', 'no_such_file'], ['--frames', '0'], ['--rate', 'nan'], ['--width', '641'],
    ['--output', 'imu'], ['--transports', 'theora'], ['--json', 'no/such/folder/file'],
    ['--add-to', 'no_such_file']))
def test_wrong_calls_are_refused_in_one_line(arguments, capsys):
    before = dict(os.environ)
    with pytest.raises(SystemExit, match='2'):
        main(arguments)
    assert capsys.readouterr().err.count('\n') == 1
    assert os.environ == before
