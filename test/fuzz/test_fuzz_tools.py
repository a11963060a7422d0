# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The tools themselves on damaged bags: whole outputs or none, never a traceback."""

from functools import cache
from pathlib import Path
import shutil
import tempfile

from fuzzing import examples, mutated, tried
from hypothesis import given, strategies as st
import pytest
import small_bags
from sph_stab_ros.evaluate import main as evaluate
from sph_stab_ros.geometry.trajectory import read_tum
from sph_stab_ros.recording import open_recording
from sph_stab_ros.replay import main as replay
from tiny_recordings import turning_spheres, write_bag

pytest.importorskip('av')


@cache
def folder():
    """Return a folder for recordings, as long as the tests run."""
    return tempfile.TemporaryDirectory(prefix='fuzz_')


@cache
def bags():
    """Return bags of a turning camera, of three kinds."""
    path = Path(folder().name)
    spheres = write_bag(path / 'turning', turning_spheres(6, 128)[0])
    messages = small_bags.image_messages(4, width=128)
    return (next(spheres.glob('*.mcap')).read_bytes(),
            small_bags.mcap(messages, compression='', checksums=False).data,
            small_bags.rosbag1(path / 'a.bag', small_bags.image_messages(4, 1, 128)).data)


def run(tool, *argv):
    """Return the exit status of a tool."""
    try:
        return tool([str(one) for one in argv])
    except SystemExit as ended:
        return ended.code


@given(data=st.deferred(lambda: mutated(*bags())), suffix=st.sampled_from(('', '.mp4')))
@examples(15)
def test_replay(data, suffix):
    path = Path(folder().name)
    bag, out, trajectory = path / 'input', path / f'out{suffix}', path / 'out.tum'
    for old in (out, trajectory):
        if old.is_dir():
            shutil.rmtree(old)
        else:
            old.unlink(missing_ok=True)
    with tried('replay', data):
        bag.write_bytes(data)
        status = run(replay, bag, out, '--trajectory', trajectory, '-p', 'view.width:=64',
                     '-p', 'view.height:=48')
        assert status in (0, 1)
        # Outputs are whole or not there.
        assert out.exists() == trajectory.exists() == (status == 0)
        if status == 0:
            assert len(trajectory.read_text().splitlines()) >= len(read_tum(trajectory)) >= 1
            written = open_recording(out, None if suffix else 'view/image/compressed')
            assert sum(1 for _ in written.frames()) >= 1


@given(data=st.deferred(lambda: mutated(*bags())))
@examples(10)
def test_evaluate(data):
    bag = Path(folder().name) / 'input'
    with tried('evaluate', data):
        bag.write_bytes(data)
        assert run(evaluate, bag, '--estimators', 'anchored', '--inject', 1) in (0, 1)
        assert run(evaluate, bag, '--estimators', 'anchored') in (0, 1)
