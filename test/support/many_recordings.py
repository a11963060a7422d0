# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A folder of recordings of all kinds, good and bad, each bad in another way."""

import json
import os
from pathlib import Path
import time

from backports import zstd
import numpy as np
from small_bags import image_messages, mcap, rosbag1, sqlite
from sph_stab_ros.batch.results import FAILURES, manifest_of, PARTIAL
from sph_stab_ros.geometry.trajectory import read_tum
from sph_stab_ros.recording.bag_writer import BagWriter
from sph_stab_ros.stabilization.imu import ImuSample
from tiny_recordings import START_NS, write_bag, write_imu, write_video

FRAMES = 4
# What the reasons must say.
BAD = {
    'cut.mcap': 'no messages',
    'cut.mp4': 'not a readable video',
    'empty.mcap': 'empty',
    'encrypted.bag': 'decrypt it first',
    'field/no_images': 'has no images',
    'field/two_cameras': 'several image topics',
    'text.bag': 'not a readable bag',
    'unreadable.mcap': 'cannot be read',
}


def write_good(folder, images):
    """Write sixteen recordings of FRAMES pictures each; return their names."""
    messages = image_messages(FRAMES, width=256)
    (folder / 'field' / 'day').mkdir(parents=True)
    names = [f'field/day/bag_{number}' for number in range(8)]
    for name in names:
        write_bag(folder / name, images[:FRAMES])
    # Where there is one, its name is that of no recording.
    (folder / 'no_suffix').write_bytes(mcap(messages).data)
    (folder / 'unfinished.mcap').write_bytes(mcap(messages, index=False).data)
    (folder / 'packed.mcap.zst').write_bytes(zstd.compress(mcap(messages).data))
    rosbag1(folder / 'old.bag', image_messages(FRAMES, generation=1, width=256))
    sqlite(folder / 'sqlite', messages)
    for name in ('ride.mp4', 'field/ride.mp4', 'ride.dat'):
        # The writer goes by the name, the reader does not.
        write_video(folder / 'video.mp4', images[:FRAMES]).rename(folder / name)
    return sorted([*names, 'no_suffix', 'unfinished.mcap', 'packed.mcap.zst', 'old.bag', 'sqlite',
                   'ride.mp4', 'field/ride.mp4', 'ride.dat'])


def write_bad(folder, images):
    """Write the recordings that BAD names, from which nothing can be had."""
    whole = mcap(image_messages(FRAMES)).data
    (folder / 'cut.mcap').write_bytes(whole[:60])
    video = write_video(folder / 'cut.mp4', images[:FRAMES])
    video.write_bytes(video.read_bytes()[:-400])
    (folder / 'empty.mcap').touch()
    (folder / 'encrypted.bag').write_bytes(
        b'Salted__' + np.random.default_rng(0).bytes(5000))
    with BagWriter(folder / 'field' / 'no_images') as bag:
        write_imu(bag, '/imu', ImuSample(START_NS, np.ones(3), np.zeros(3)))
    with BagWriter(folder / 'field' / 'two_cameras') as bag:
        for topic in ('/left', '/right'):
            bag.write_jpeg(topic, START_NS, 'camera', images[0])
    (folder / 'text.bag').write_text('see the other disk\n')
    unreadable = folder / 'unreadable.mcap'
    if os.geteuid():
        unreadable.write_bytes(whole)
        unreadable.chmod(0)
    else:
        # Root may read all but what leads in a circle.
        unreadable.symlink_to(unreadable.name)


def write_others(folder):
    """Write what is no recording and is not called one."""
    (folder / 'README.md').write_text('# Recordings\n')
    (folder / 'field' / 'poses.tum').write_text('0 0 0 0 0 0 0 1\n')
    (folder / '.hidden.bag').write_text('no recording')


def inodes(out):
    """Return by name which files results are: one that is made anew is another one."""
    return {path.relative_to(out).as_posix(): (path.stat().st_ino, path.stat().st_mtime_ns)
            for path in Path(out).rglob('*') if path.is_file() and path.parent != out}


def workers_of(pid):
    """Return the processes that a process has started."""
    found = []
    for stat in Path('/proc').glob('[0-9]*/stat'):
        try:
            fields = stat.read_text().rpartition(')')[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found.append(int(stat.parent.name))
    return found


def wait_until_something_is_written(out, process):
    """Return when a result is begun, but long before it is whole."""
    while process.poll() is None and not any(out.glob(f'{PARTIAL}/*/*.partial/*')):
        time.sleep(0.02)
    assert process.poll() is None


def check_results(out, frames_of, table):
    """Check that all good recordings have whole results, and bad ones reasons in a table."""
    assert {path.parent.relative_to(out).as_posix()
            for path in out.rglob('manifest.json')} == set(frames_of)
    for name, frames in frames_of.items():
        assert manifest_of(out / name)['frames'] == frames
        assert len(read_tum(out / name / 'trajectory.tum')) == frames
        assert (out / name / 'stabilized.mp4').stat().st_size
    failures = json.loads((out / FAILURES).read_text())
    assert failures.keys() == BAD.keys()
    for (name, reason), line in zip(sorted(BAD.items()), table, strict=True):
        assert reason in failures[name]['reason']
        assert line.split()[0] == name and reason in line
    assert not (out / PARTIAL).exists()
