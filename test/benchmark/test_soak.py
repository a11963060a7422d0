# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The soak's checks catch what they are there for; a very short one runs against the node."""

import json
import subprocess
import sys

import numpy as np
import pytest
from sph_stab_ros.command_line.processes import cpu_s, memory_mb
from sph_stab_ros.config import ConfigError, NODE_PARAMETERS, VIEW, view_parameters

pytest.importorskip('rclpy', reason='rclpy is not installed')

from node_harness import DOMAINS  # noqa: E402, I100
from sph_stab_ros.benchmark.soak import CHANGES, failures, fitted_line, main  # noqa: E402
from sph_stab_ros.evaluation.docs_tables import filled  # noqa: E402

GOOD = {'failures': [], 'longest_gap_s': 1.1, 'beats_without_frames': 0, 'memory_mb': 100.,
        'memory_growth_mb': 0.5, 'exit_status': {'node': 0, 'player': 0}}


def test_a_good_report_has_no_failures():
    assert failures(GOOD) == []


@pytest.mark.parametrize('bad, said', (
    ({'longest_gap_s': 2.}, 'apart'), ({'beats_without_frames': 1}, 'without a new frame'),
    ({'memory_growth_mb': 5.1}, 'memory grew'), ({'failures': ['second 3: no answer']}, 'second'),
    ({'exit_status': {'node': -11, 'player': 0}}, 'node ended with status -11'),
    ({'exit_status': {'node': 0, 'player': 1}}, 'player ended with status 1')))
def test_each_check_gives_a_line(bad, said):
    line, = failures({**GOOD, **bad})
    assert said in line


def test_a_leak_is_seen_through_fluctuations():
    noise_mb = np.random.default_rng(0).normal(0, 10, 540)
    for leak_mb in (0., 40.):
        start, rise = fitted_line(100 + np.linspace(0, leak_mb, 540) + noise_mb)
        assert start == pytest.approx(100, abs=3) and rise == pytest.approx(leak_mb, abs=5)


def test_a_line_is_fitted_exactly():
    assert fitted_line([10., 12., 14.]) == pytest.approx((10., 4.))


def test_changes_are_what_the_node_takes_and_refuses():
    options = NODE_PARAMETERS | view_parameters(VIEW)
    for name, value, good in CHANGES:
        if name != 'mask':
            if good:
                options[name].check(value)
            else:
                with pytest.raises(ConfigError):
                    options[name].check(value)


def test_after_all_changes_everything_is_as_it_was():
    options = NODE_PARAMETERS | view_parameters(VIEW)
    last = {name: value for name, value, good in CHANGES if good}
    assert last == {name: options[name].default for name in last}


def test_a_process_is_measured():
    code = ('import time; memory = bytearray(b"x" * 200_000_000)\nwhile time.process_time() < 1:\n'
            ' pass\nprint(time.process_time(), flush=True); input()')
    with subprocess.Popen([sys.executable, '-c', code], stdin=subprocess.PIPE,
                          stdout=subprocess.PIPE) as process:
        own_cpu_s = float(process.stdout.readline())
        memory = memory_mb(process.pid)
        assert memory['rss'] >= memory['private'] > 200
        # In ticks of 10 ms, for each of user and system.
        assert cpu_s(process.pid) == pytest.approx(own_cpu_s, abs=0.05)
        process.communicate(b'\n')


@pytest.mark.ros
def test_a_few_seconds_pass(turning_bag, tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_DOMAIN_ID', str(next(DOMAINS)))
    report = tmp_path / 'soak.json'
    assert main([str(turning_bag), '--seconds', '4', '--json', str(report)]) == 0
    report = json.loads(report.read_text())
    assert report['seconds'] == 4 and report['frames'] > 0 and report['heartbeats'] > 2
    assert sum(report['received'].values()) > 0
    assert 'memory_mb' not in report
    assert '| – | passed |' in filled('<!-- soak soak -->\n<!-- end -->', tmp_path)


@pytest.mark.parametrize('arguments', (
    ['--seconds', '1'], ['--seconds', 'long'], ['no_such_bag'], ['--json', 'no/such/folder/file']))
def test_wrong_calls_are_refused_in_one_line(arguments, capsys):
    with pytest.raises(SystemExit, match='2'):
        main(arguments)
    assert capsys.readouterr().err.count('\n') == 1
