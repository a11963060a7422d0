# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What batch is made of: finding recordings, telling them apart, results, and processes."""

from argparse import Namespace
from collections import Counter
from dataclasses import replace
import math
import signal
from threading import Lock
import time

import pytest
from sph_stab_ros.batch import local, results
from sph_stab_ros.batch.discovery import find_recordings
from sph_stab_ros.batch.results import content_of, identity_of, manifest_of, publish, write_json
from sph_stab_ros.batch.tasks import Again, Outcome, Processes, Progress, RETRIES, run_task, Task
from sph_stab_ros.config import Settings
from sph_stab_ros.recording import RecordingError
from tiny_recordings import write_bag


def names_in(*inputs, out):
    """Return the names of what is found."""
    return [found.name for found in find_recordings(inputs, out)]


def test_a_bag_is_one_recording_and_a_folder_of_bags_is_several(turning_bag, tmp_path):
    """Whatever the parts are called where there is metadata, and by their names where not."""
    out = tmp_path / 'out'
    data = next(turning_bag.glob('*.mcap')).read_bytes()
    for folder, names in (('split', ('split_0.mcap', 'split_1.mcap')), ('day', ('a.mcap', 'b'))):
        (tmp_path / folder).mkdir()
        for name in names:
            (tmp_path / folder / name).write_bytes(data)
    assert names_in(tmp_path, out=out) == ['day/a.mcap', 'day/b', 'split']
    assert names_in(tmp_path / 'split', out=out) == ['split']
    (tmp_path / 'day' / 'metadata.yaml').touch()
    assert names_in(tmp_path, out=out) == ['day', 'split']
    # Results are no recordings of the next call's.
    assert names_in(tmp_path, out=tmp_path / 'day') == ['split']


def test_results_of_the_same_name_are_refused(turning_bag, tmp_path):
    """Naming one recording twice is no harm."""
    other = tmp_path / turning_bag.name
    other.symlink_to(turning_bag)
    assert names_in(turning_bag, turning_bag, out=tmp_path / 'out') == ['bag']
    with pytest.raises(RecordingError, match='of the same name'):
        names_in(turning_bag, other, out=tmp_path / 'out')


@pytest.mark.parametrize('whole_bytes', [results.WHOLE_BYTES, 1000])
def test_a_recording_is_its_content(tmp_path, monkeypatch, whole_bytes):
    """Not its name or its time; of a large one its ends and its length count in any case."""
    monkeypatch.setattr(results, 'WHOLE_BYTES', whole_bytes)
    monkeypatch.setattr(results, 'BLOCK_BYTES', 10)
    data = bytes(range(256)) * 100
    for name, content in {
            'same': data, 'first': b'\1' + data[1:], 'last': data[:-1] + b'\1',
            'longer': data + b'\0'}.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / 'original').write_bytes(data)
    original = content_of(tmp_path / 'original')
    assert content_of(tmp_path / 'same') == original
    for name in ('first', 'last', 'longer'):
        assert content_of(tmp_path / name)['sha256'] != original['sha256']
    (tmp_path / 'same-wal').write_bytes(b'more')
    assert content_of(tmp_path / 'same') != original


def test_the_first_of_two_same_results_stays_and_another_one_is_replaced(tmp_path):
    """Two workers may have made it: there is one of it."""
    result = tmp_path / 'results' / 'name'
    for attempt, (identity, stays) in enumerate((('a', 0), ('a', 0), ('b', 2))):
        partial = tmp_path / f'partial_{attempt}'
        partial.mkdir()
        (partial / 'which').write_text(str(attempt))
        write_json(partial / 'manifest.json', {
            'identity': {'of': identity}, 'outputs': {'which': 1}})
        publish(partial, result, {'of': identity})
        assert (result / 'which').read_text() == str(stays)
        assert manifest_of(result)['identity'] == {'of': identity}


@pytest.fixture
def task(tmp_path, turning):
    """Return the Task of a recording of some seconds."""
    bag = write_bag(tmp_path / 'bag', 25 * turning[0])
    args = Namespace(image_topic=None, imu_topic=None, start=0., end=math.inf, max_frames=None,
                     view=None, side_by_side=False, offline=False, report=False)
    return Task('bag', bag, tmp_path / 'out', identity_of(bag, {}), args, Settings(), None,
                evaluate=False, track=True, memory_mb=2000)


class Killer:
    """Kills the process whenever it says how far it is, so many times."""

    def __init__(self, times):
        self.processes, self.times, self.events = Processes(), times, []

    def __call__(self, event):
        """Take in what a task says."""
        self.events.append(event)
        if isinstance(event, Progress) and self.times:
            self.times -= 1
            for process in self.processes._running:
                process.send_signal(signal.SIGKILL)


@pytest.mark.slow
def test_a_task_outlives_its_process(task):
    """Another one begins from the start."""
    say = Killer(1)
    outcome = run_task(task, say, say.processes)
    assert not outcome.failed and outcome.line.startswith('300 frames')
    assert [event for event in say.events if isinstance(event, Again)] == [
        Again('bag', 'its process was ended by SIGKILL')]
    assert manifest_of(task.out / 'bag')['frames'] == 300
    assert not list((task.out / '.partial').iterdir())


@pytest.mark.slow
def test_a_task_that_kills_every_process_is_given_up(task):
    """With the reason, and nothing left."""
    say = Killer(100)
    outcome = run_task(task, say, say.processes)
    assert outcome == Outcome(
        'bag', f'its process was ended by SIGKILL, {1 + RETRIES} times', failed=True)
    assert not (task.out / 'bag').exists() and not list((task.out / '.partial').iterdir())


def test_a_process_whose_result_nobody_wants_ends(task):
    """It sees that its folder is gone."""
    def say(event):
        for folder in (task.out / '.partial').iterdir():
            folder.rename(task.out / 'gone')
    outcome = run_task(task, say, Processes())
    assert outcome.failed and not outcome.lasting
    assert not (task.out / 'bag').exists()


def test_no_more_than_so_many_at_once_and_each_once(task, monkeypatch):
    """Whatever the order in which they end."""
    lock, running, most, begun = Lock(), set(), [0], Counter()

    def pretend(task, say, processes):
        with lock:
            running.add(task.name)
            begun[task.name] += 1
            most[0] = max(most[0], len(running))
        time.sleep(0.01 * (int(task.name) % 3))
        with lock:
            running.remove(task.name)
        if task.name == '7':
            raise ValueError('of its own')
        return Outcome(task.name, 'done')
    monkeypatch.setattr(local, 'run_task', pretend)
    tasks = [replace(task, name=str(number)) for number in range(20)]
    outcomes = list(local.run_here(tasks, 3))
    assert most[0] == 3
    assert begun == Counter(one.name for one in outcomes) == Counter(map(str, range(20)))
    assert [one.line for one in outcomes if one.failed] == ['ValueError: of its own']


def test_what_nobody_waits_for_does_not_begin_again(task):
    """Its folder is gone, as after an interrupted batch on a cluster, and then it is killed."""
    say = Killer(100)

    def give_up(event):
        for folder in (task.out / '.partial').iterdir():
            folder.rename(task.out / 'gone')
        say(event)
    outcome = run_task(task, give_up, say.processes)
    assert outcome.failed and not any(isinstance(event, Again) for event in say.events)
    assert not (task.out / 'bag').exists()
