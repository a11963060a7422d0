# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The command batch: whole results or a reason, and the same call goes on after any end."""

import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from many_recordings import (
    BAD, check_results, FRAMES, inodes, wait_until_something_is_written, workers_of, write_bad,
    write_good, write_others)
import numpy as np
import pytest
from sph_stab_ros.batch.__main__ import main
from sph_stab_ros.batch.results import FAILURES, LOCK, manifest_of
from sph_stab_ros.batch.tasks import Processes
from sph_stab_ros.geometry.trajectory import read_tum
from sph_stab_ros.simulation.__main__ import main as simulate
from tiny_recordings import turning_spheres, write_bag


def call(*args, expect=0):
    """Run the command in this process and check its exit status."""
    try:
        status = main([str(arg) for arg in args])
    except SystemExit as end:
        status = end.code
    assert status == expect


def start(*args):
    """Start the command as a process of its own."""
    return subprocess.Popen(
        [sys.executable, '-m', 'sph_stab_ros.batch', *map(str, args)], text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE)


@pytest.fixture
def no_process(monkeypatch):
    """Let no process be started."""
    def refuse(*_):
        raise AssertionError('a process was started')
    monkeypatch.setattr(Processes, 'start', refuse)


@pytest.fixture(scope='module')
def long_bags(tmp_path_factory, turning):
    """Return a folder of three recordings of some seconds each."""
    folder = tmp_path_factory.mktemp('long')
    for number in range(3):
        write_bag(folder / f'bag_{number}', 40 * turning[0])
    return folder


@pytest.mark.slow
def test_of_many_all_good_ones_have_results_and_all_bad_ones_reasons(
        tmp_path, turning, capsys, monkeypatch):
    """And a second call does nothing, but says the same."""
    pytest.importorskip('av')
    folder, out = tmp_path / 'in', tmp_path / 'out'
    good = write_good(folder, turning[0])
    write_bad(folder, turning[0])
    write_others(folder)
    assert (len(good), len(BAD)) == (16, 8)
    call(folder, '--out', out, expect=1)
    said = capsys.readouterr()
    assert said.err == 'batch: 8 of 24 recordings have no result\n'
    table = said.out.splitlines()[-8:]
    check_results(out, dict.fromkeys(good, FRAMES), table)

    before = inodes(out)
    monkeypatch.setattr(Processes, 'start', None)
    call(folder, '--out', out, expect=1)
    again = capsys.readouterr()
    assert again.err == said.err and again.out.splitlines()[-8:] == table
    assert f'24 recordings into {out}: 16 done, 8 failed' in again.out
    assert inodes(out) == before


def test_a_plan_is_shown_and_nothing_else_is_done(turning_bag, tmp_path, capsys, no_process):
    """With --dry-run."""
    call(turning_bag, '--out', tmp_path / 'out', '--dry-run')
    said = capsys.readouterr()
    assert said.err == '' and said.out.splitlines() == [
        'bag  to do  0.1 MB', f'1 recordings into {tmp_path / "out"}: 1 to do']
    assert not list(tmp_path.iterdir())


def test_what_has_changed_is_named_and_replaced_only_by_force(turning, tmp_path, capsys):
    """Another content, or other options."""
    bag, out = write_bag(tmp_path / 'bag', turning[0][:FRAMES]), tmp_path / 'out'
    write = ('--out', out, '--write', 'trajectory')
    call(bag, *write)
    before = inodes(out)
    capsys.readouterr()
    call(bag, *write, '--max-frames', '3', expect=1)
    assert 'made with other options; --force replaces it' in capsys.readouterr().out
    part, = bag.glob('*.mcap')
    part.write_bytes(part.read_bytes()[:-1])
    call(bag, *write, expect=1)
    assert 'made of another content; --force replaces it' in capsys.readouterr().out
    assert inodes(out) == before
    call(bag, *write, '--max-frames', '3', '--force')
    assert manifest_of(out / 'bag')['frames'] == 3
    assert len(read_tum(out / 'bag' / 'trajectory.tum')) == 3


def test_a_result_that_is_not_whole_any_more_is_made_again(turning_bag, tmp_path):
    """As a disk may leave it that has lost power; nothing that is no result is touched."""
    out = tmp_path / 'out'
    write = ('--out', out, '--write', 'trajectory')
    call(turning_bag, *write)
    trajectory = out / 'bag' / 'trajectory.tum'
    whole = trajectory.read_bytes()
    trajectory.write_bytes(whole[:-100])
    call(turning_bag, *write)
    assert trajectory.read_bytes() == whole
    (out / 'bag' / 'manifest.json').unlink()
    call(turning_bag, *write, expect=1)
    assert trajectory.read_bytes() == whole


@pytest.mark.slow
def test_one_table_over_all_that_have_truth(turning, tmp_path, capsys):
    """Asked for later, it tracks nothing again."""
    folder, out = tmp_path / 'in', tmp_path / 'out'
    folder.mkdir()
    for name in ('flight_a', 'flight_b'):
        assert simulate(['synthetic', str(folder / name), '--frames-limit', '12', '--width', '256',
                         '--seed', str(len(name))]) == 0
    write_bag(folder / 'unknown', turning[0][:FRAMES])
    write = ('--out', out, '--write', 'trajectory')
    call(folder, *write)
    trajectories = [inodes(out)[f'{name}/trajectory.tum'] for name in ('flight_a', 'flight_b')]
    capsys.readouterr()
    call(folder, *write, '--evaluate')
    said = capsys.readouterr().out
    assert '3 evaluate' in said and '1 have no truth' in said and 'mean of 2' in said
    table = json.loads((out / 'evaluation.json').read_text())
    assert table.keys() == {'flight_a', 'flight_b'}
    for figures in table.values():
        assert figures['frames'] == 12 and 0 < figures['per_frame_deg']['median'] < 1
    assert trajectories == [
        inodes(out)[f'{name}/trajectory.tum'] for name in ('flight_a', 'flight_b')]
    before = inodes(out)
    call(folder, *write, '--evaluate')
    assert inodes(out) == before and 'mean of 2' in capsys.readouterr().out


@pytest.mark.slow
def test_a_killed_process_loses_nothing_and_does_nothing_twice(long_bags, tmp_path):
    """Of the command's processes one is killed while it writes."""
    out = tmp_path / 'out'
    process = start(long_bags, '--out', out, '--jobs', '2')
    wait_until_something_is_written(out, process)
    os.kill(workers_of(process.pid)[0], signal.SIGKILL)
    said, error = process.communicate(timeout=300)
    assert (process.returncode, error) == (0, '')
    lines = said.splitlines()
    assert sum('ended by SIGKILL; it begins again' in line for line in lines) == 1
    names = ['bag_0', 'bag_1', 'bag_2']
    assert sorted(line.split(':')[0] for line in lines if ': 480 frames in' in line) == names
    for name in names:
        assert manifest_of(out / name)['frames'] == 480
    assert {path.name for path in out.iterdir()} == {*names, FAILURES, LOCK}


@pytest.mark.parametrize('ending', [
    signal.SIGKILL, *(pytest.param(softer, marks=pytest.mark.slow)
                      for softer in (signal.SIGINT, signal.SIGTERM))])
def test_after_any_end_the_same_call_goes_on(long_bags, tmp_path, ending):
    """Asked to end, it says one line and leaves nothing half-written; killed, it cannot."""
    out = tmp_path / 'out'
    process = start(long_bags, '--out', out, '--jobs', '1', '--write', 'trajectory')
    while process.poll() is None and not (out / 'bag_0').is_dir():
        time.sleep(0.02)
    wait_until_something_is_written(out, process)
    workers = workers_of(process.pid)
    process.send_signal(ending)
    _, error = process.communicate(timeout=60)
    if ending == signal.SIGKILL:
        assert process.returncode == -ending
    else:
        assert process.returncode == 1
        assert error == ('batch: interrupted, 1 of 3 are done; the same call goes on with the '
                         'others\n')
        assert {path.name for path in out.iterdir()} == {'bag_0', FAILURES, LOCK}
    # Of one that was killed they see it by themselves.
    deadline_s = time.monotonic() + 60
    while any(Path(f'/proc/{pid}').is_dir() for pid in workers):
        assert time.monotonic() < deadline_s
        time.sleep(0.1)
    before = inodes(out / 'bag_0')
    call(long_bags, '--out', out, '--jobs', '1', '--write', 'trajectory')
    assert inodes(out / 'bag_0') == before
    assert {path.name for path in out.iterdir()} == {'bag_0', 'bag_1', 'bag_2', FAILURES, LOCK}


def test_two_batches_do_not_write_into_the_same_folder(long_bags, tmp_path, capsys):
    """The second one says so."""
    out = tmp_path / 'out'
    process = start(long_bags, '--out', out, '--jobs', '1')
    wait_until_something_is_written(out, process)
    call(long_bags, '--out', out, expect=1)
    assert capsys.readouterr().err == f'batch: another batch writes into {out}\n'
    process.terminate()
    process.communicate(timeout=60)


@pytest.mark.parametrize('args', [
    ('{bag}',), ('--out', '{new}'), ('{bag}', '--out', '{new}', '--jobs', '0'),
    ('{bag}', '--out', '{new}', '--memory-mb', 'x'), ('{bag}', '--out', '{new}', '--write', 'avi'),
    ('{bag}', '--out', '{new}', '--write', 'bag', '--side-by-side'),
    ('{bag}', '--out', '{new}', '--write', 'trajectory', '--view', '0,0,0,90'),
    ('{bag}', '--out', '{new}', '--smoothing', 'magic'),
    ('{bag}', '--out', '{new}', '--scheduler', 'tcp://host:1', '--jobs', '2'),
    ('{bag}', '--out', '{new}', '--split', '2'),
    ('{bag}', '--out', '{new}', '--split', '60', '--start', '1'),
    ('{bag}', '--out', '{new}', '--split', '60', '-p', 'level:=imu'),
    ('{bag}', '--out', '{new}', '--split', '60', '--estimator', 'pts')])
def test_a_wrong_call_ends_with_2_and_one_line(turning_bag, tmp_path, capsys, args):
    """Nothing is begun."""
    call(*(arg.format(bag=turning_bag, new=tmp_path / 'new') for arg in args), expect=2)
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize('inputs, message', [
    (('{tmp}/missing',), 'does not exist'), (('{tmp}/empty',), 'no recording in')])
def test_a_failure_ends_with_1_and_one_line(tmp_path, capsys, inputs, message):
    """Nothing is left behind."""
    (tmp_path / 'empty').mkdir()
    call(*(one.format(tmp=tmp_path) for one in inputs), '--out', tmp_path / 'out', expect=1)
    error, = capsys.readouterr().err.splitlines()
    assert message in error and not (tmp_path / 'out').exists()


@pytest.mark.thorough
def test_what_needs_more_memory_than_it_may_have_fails_alone(tmp_path, capsys):
    """In one line."""
    pytest.importorskip('av')
    folder, out = tmp_path / 'in', tmp_path / 'out'
    folder.mkdir()
    write_bag(folder / 'large', [np.full((4096, 8192, 3), 90, np.uint8)])
    write_bag(folder / 'small', turning_spheres(2)[0])
    call(folder, '--out', out, '--memory-mb', '500', expect=1)
    assert capsys.readouterr().out.splitlines()[-1] == (
        'large  it needs more memory than 500 MB (--memory-mb)')
    assert manifest_of(out / 'small') and not (out / 'large').exists()
