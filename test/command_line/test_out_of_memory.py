# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What does not fit into the memory is not said to be damaged."""

from pathlib import Path
import subprocess
import sys

import cv2
import numpy as np
import pytest
from sph_stab_ros.recording import open_recording
from tiny_recordings import turning_spheres, write_bag

ROOT = Path(__file__).resolve().parents[2]
# A process may have so many MB more than it has by then.
LIMITED = """
import resource, sys
def limit(more_mb):
    status = dict(line.split(':') for line in open('/proc/self/status'))
    most = (int(status['VmData'].split()[0]) << 10) + (int(more_mb) << 20)
    resource.setrlimit(resource.RLIMIT_DATA, (most, most))
"""
DECODE = LIMITED + """
from sph_stab_ros.images.codec import ImageError, image_from_compressed
data = open(sys.argv[1], 'rb').read()
limit(float(sys.argv[2]))
try:
    print(image_from_compressed(data).shape)
except (ImageError, MemoryError) as error:
    print(type(error).__name__)
"""
# The first one imports what is wanted only then.
REPLAY = LIMITED + """
from sph_stab_ros.replay import main
main([sys.argv[1], sys.argv[3]])
limit(40)
sys.exit(main([sys.argv[2], sys.argv[3], '--force']))
"""


def python(program, *args):
    """Return how a program has ended, run by a process of its own."""
    return subprocess.run([sys.executable, '-c', program, *map(str, args)], cwd=ROOT, text=True,
                          capture_output=True, timeout=60)


@pytest.fixture(scope='module')
def large():
    """Return a grey sphere that takes 25 MB, 100 where it is decoded in colour."""
    return np.full((2896, 5792, 3), 90, np.uint8)


@pytest.mark.parametrize('suffix, flags', [
    ('.jpg', []), ('.jpg', [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]), ('.png', [])])
@pytest.mark.parametrize('is_damaged, more_mb, said', [
    (False, 40, 'MemoryError'), (False, 600, '(2896, 5792, 3)'), (True, 600, 'ImageError')])
def test_decoding_tells_damage_from_want_of_memory(
        large, tmp_path, suffix, flags, is_damaged, more_mb, said):
    data = bytearray(cv2.imencode(suffix, large, flags)[1].tobytes())
    if is_damaged:
        # The header with the size stays.
        data[200:-12] = bytes(len(data) - 212)
    (tmp_path / 'picture').write_bytes(data)
    ended = python(DECODE, tmp_path / 'picture', more_mb)
    assert (ended.stdout.strip(), ended.returncode) == (said, 0), ended.stderr


def test_a_command_says_so_in_one_line(large, tmp_path):
    """What was there before it is still there."""
    out = tmp_path / 'out'
    write_bag(tmp_path / 'small', turning_spheres(2)[0])
    write_bag(tmp_path / 'large', [large, large])
    ended = python(REPLAY, tmp_path / 'small', tmp_path / 'large', out)
    assert (ended.returncode, ended.stderr) == (1, 'replay: there is not enough memory\n')
    assert sum(1 for _ in open_recording(out, 'stabilized/image/compressed').frames()) == 2
    assert {path.name for path in tmp_path.iterdir()} == {'small', 'large', out.name}
