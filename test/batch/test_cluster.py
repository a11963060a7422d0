# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Batch on a real Dask cluster: a scheduler and workers, each a process of its own."""

import json
import os
import signal
import subprocess
import sys
import time

from many_recordings import (
    BAD, check_results, FRAMES, inodes, workers_of, write_bad, write_good, write_others)
import pytest
from sph_stab_ros.batch.cluster import run_on_cluster
from sph_stab_ros.recording import RecordingError
from tiny_recordings import write_bag

STARTING_S = 120


def start(module, *args):
    """Start a process of this Python's."""
    return subprocess.Popen([sys.executable, '-m', module, *map(str, args)], text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE)


@pytest.fixture
def cluster(tmp_path):
    """Return the address of a scheduler, and its two workers, which do one thing at a time."""
    pytest.importorskip('distributed', reason='distributed is not installed')
    file, log = tmp_path / 'scheduler.json', (tmp_path / 'log').open('w')
    common = ('--scheduler-file', file, '--no-dashboard')
    processes = []
    for module, *args in (
            ('dask_scheduler', '--host', '127.0.0.1', '--port', '0'),
            *2 * (('dask_worker', '--nthreads', '1', '--no-nanny', '--local-directory',
                   tmp_path / 'dask'),)):
        processes.append(subprocess.Popen(
            [sys.executable, '-m', f'distributed.cli.{module}', *map(str, (*common, *args))],
            stdout=log, stderr=log))
    deadline_s = time.monotonic() + STARTING_S
    while not file.exists() or (tmp_path / 'log').read_text().count('Registered to:') < 2:
        assert time.monotonic() < deadline_s, (tmp_path / 'log').read_text()
        time.sleep(0.1)
    yield json.loads(file.read_text())['address'], processes[1:]
    for process in processes:
        process.kill()
        process.wait()


@pytest.mark.slow
def test_a_lost_worker_loses_nothing_and_does_nothing_twice(cluster, tmp_path, turning):
    """Of two workers one is killed while it has work, and the other one stands still a while."""
    pytest.importorskip('av')
    address, workers = cluster
    folder, out = tmp_path / 'in', tmp_path / 'out'
    good = dict.fromkeys(write_good(folder, turning[0]), FRAMES)
    write_bag(folder / 'long', 40 * turning[0])
    del good['ride.dat']
    (folder / 'ride.dat').unlink()
    good['long'] = 480
    write_bad(folder, turning[0])
    write_others(folder)
    assert (len(good), len(BAD)) == (16, 8)
    process = start('sph_stab_ros.batch', folder, '--out', out, '--scheduler', address)
    while process.poll() is None and not any(out.rglob('manifest.json')):
        time.sleep(0.05)
    while not (children := workers_of(workers[0].pid)):
        assert process.poll() is None
        time.sleep(0.01)
    workers[0].kill()
    os.kill(workers[1].pid, signal.SIGSTOP)
    time.sleep(3)
    os.kill(workers[1].pid, signal.SIGCONT)
    said, error = process.communicate(timeout=600)
    assert (process.returncode, error) == (1, 'batch: 8 of 24 recordings have no result\n')
    assert len(children) == 1
    lines = said.splitlines()
    check_results(out, good, lines[-8:])
    assert sorted(line.split(':')[0] for line in lines if ' frames in ' in line) == sorted(good)

    before = inodes(out)
    # With whoever would do something.
    for worker in workers:
        worker.kill()
    again = start('sph_stab_ros.batch', folder, '--out', out, '--scheduler', address)
    said, error = again.communicate(timeout=60)
    assert (again.returncode, error) == (1, 'batch: 8 of 24 recordings have no result\n')
    assert f'24 recordings into {out}: 16 done, 8 failed' in said
    assert inodes(out) == before


@pytest.mark.slow
def test_segments_are_tracked_by_several_workers(cluster, tmp_path, turning):
    """And joined by one of them: the same as on one machine."""
    address, _ = cluster
    bag, found = write_bag(tmp_path / 'bag', 40 * turning[0]), []
    for out, args in ((tmp_path / 'here', ()), (tmp_path / 'there', ('--scheduler', address))):
        process = start('sph_stab_ros.batch', bag, '--out', out, '--write', 'trajectory',
                        '--split', '10', *args)
        said, error = process.communicate(timeout=600)
        assert (process.returncode, error) == (0, '')
        assert 'bag [1 of 2]: ' in said and 'bag [2 of 2]: ' in said
        found.append((out / 'bag' / 'trajectory.tum').read_text())
    assert found[0] == found[1]


def test_what_is_missing_is_said(monkeypatch):
    """Without Dask, or without its scheduler."""
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, 'distributed', None)
        with pytest.raises(RecordingError, match=r'sph_stab_ros\[cluster\]'):
            next(run_on_cluster([], 'tcp://127.0.0.1:1'))
    pytest.importorskip('distributed', reason='distributed is not installed')
    monkeypatch.setattr('sph_stab_ros.batch.cluster.CONNECTING_S', 1)
    with pytest.raises(RecordingError, match='no Dask scheduler answers at tcp://127.0.0.1:1'):
        next(run_on_cluster([], 'tcp://127.0.0.1:1'))
