# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Outputs are written whole, or not at all, or are marked."""

import os
from stat import S_ISFIFO
from threading import Thread

import pytest
from sph_stab_ros.recording import RecordingError
from sph_stab_ros.recording.partial_output import partial_output


def test_an_output_appears_only_when_it_is_whole(tmp_path):
    """While it is written it has another name; an error leaves nothing."""
    path = tmp_path / 'out.txt'
    with partial_output(path) as partial:
        partial.write_text('new')
        assert '.partial' in str(partial) and not path.exists()
    assert path.read_text() == 'new'
    with pytest.raises(RuntimeError):
        with partial_output(tmp_path / 'other.txt') as partial:
            partial.write_text('half')
            raise RuntimeError
    assert [file.name for file in tmp_path.iterdir()] == ['out.txt']


@pytest.mark.parametrize('folder', [False, True])
def test_existing_outputs_stay_until_the_new_one_is_whole(tmp_path, folder):
    """Without force they are not touched; with force they are replaced at the end."""
    def write(path, text):
        if folder:
            path.mkdir()
            path = path / 'content'
        path.write_text(text)

    def read(path):
        return (path / 'content' if folder else path).read_text()

    path = tmp_path / 'out'
    write(path, 'old')
    with pytest.raises(RecordingError, match='exists.*--force'):
        with partial_output(path):
            pass
    with pytest.raises(RuntimeError):
        with partial_output(path, True, ['content'] if folder else ()) as partial:
            write(partial, 'half')
            raise RuntimeError
    assert read(path) == 'old'
    with partial_output(path, True, ['content'] if folder else ()) as partial:
        write(partial, 'new')
        assert read(path) == 'old'
    assert read(path) == 'new'
    assert [file.name for file in tmp_path.iterdir()] == ['out']


def test_an_interrupted_output_stays_marked(tmp_path):
    """What was written is kept under a name that tells it from a whole one."""
    path = tmp_path / 'out.txt'
    with pytest.raises(KeyboardInterrupt):
        with partial_output(path) as partial:
            partial.write_text('half')
            raise KeyboardInterrupt
    assert not path.exists()
    assert partial.read_text() == 'half' and '.partial' in str(partial)


@pytest.mark.parametrize('parent', ['missing', 'file.txt'])
def test_an_unwritable_place_is_named(tmp_path, parent):
    """A folder that is not there, or is none."""
    (tmp_path / 'file.txt').touch()
    with pytest.raises(RecordingError, match='cannot be written'):
        with partial_output(tmp_path / parent / 'out'):
            pass


@pytest.mark.parametrize('inside', ['ride.mp4', 'more/out.mcap', None])
@pytest.mark.parametrize('holds', [(), ('*.mcap', 'metadata.yaml')])
def test_no_folder_of_other_things_is_replaced(tmp_path, inside, holds):
    """Whoever asks for the wrong one, of all recordings perhaps, does not lose it."""
    path = tmp_path / 'rides'
    path.mkdir()
    for name in filter(None, ('out.mcap', inside)):
        (path / name).parent.mkdir(exist_ok=True)
        (path / name).touch()
    try:
        with partial_output(path, True, holds) as partial:
            partial.mkdir()
    except RecordingError as error:
        assert 'is a folder of something else' in str(error) and (path / 'out.mcap').exists()
        assert inside or not holds
    else:
        assert holds and not inside and not list(path.iterdir())
    assert [one.name for one in tmp_path.iterdir()] == ['rides']


def test_pipes_are_written_to_and_stay(tmp_path):
    """So does what else nothing can be moved to, such as /dev/stdout."""
    path = tmp_path / 'pipe'
    os.mkfifo(path)
    heard = []
    reader = Thread(target=lambda: heard.append(path.read_text()))
    reader.start()
    with partial_output(path) as given:
        given.write_text('all')
    reader.join()
    assert heard == ['all'] and S_ISFIFO(path.stat().st_mode)


def test_of_a_link_the_target_is_replaced(tmp_path):
    (tmp_path / 'disk').mkdir()
    (tmp_path / 'link').symlink_to(tmp_path / 'disk' / 'file')
    with partial_output(tmp_path / 'link') as partial:
        partial.write_text('new')
    assert (tmp_path / 'link').is_symlink()
    assert (tmp_path / 'disk' / 'file').read_text() == 'new'
