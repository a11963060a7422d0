# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Names and texts are what they are, whatever the locale and wherever they go."""

import os
import subprocess
import sys

import pytest
from sph_stab_ros.command_line import one_line
from tiny_recordings import turning_spheres, write_bag

# Python takes C for UTF-8 unless it is told not to.
LOCALES = {'C': {'LC_ALL': 'C', 'PYTHONUTF8': '0', 'PYTHONCOERCECLOCALE': '0'},
           'UTF-8': {'LC_ALL': 'C.UTF-8'}}


@pytest.mark.parametrize('locale', LOCALES)
@pytest.mark.parametrize('name', ['Größe'.encode(), b'\xff\xfe'])
def test_names_and_texts_are_of_no_locale(tmp_path, name, locale):
    """A report is written, names are told, and parameters read with their comments."""
    bag = write_bag(tmp_path / os.fsdecode(name), turning_spheres(3)[0])
    (tmp_path / 'robot.yaml').write_bytes(
        b'\xef\xbb\xbf# Gr\xc3\xb6\xc3\x9fe\n/**: {ros__parameters: {working_width: 256}}\n')
    report, tum = tmp_path / 'report.html', tmp_path / 'out.tum'
    done = subprocess.run(
        [sys.executable, '-m', 'sph_stab_ros.replay', bag, '--trajectory', tum, '--report', report,
         '--params-file', tmp_path / 'robot.yaml'],
        env={**os.environ, **LOCALES[locale]}, stderr=subprocess.PIPE, check=False)
    assert (done.returncode, done.stderr) == (0, b'')
    assert len(tum.read_text().splitlines()) == 3
    # What the locale does not know is told by numbers.
    shown = name.decode('utf-8' if locale == 'UTF-8' else 'ascii', 'surrogateescape')
    assert one_line(shown) in report.read_text('utf-8')
    done = subprocess.run(
        [sys.executable, '-m', 'sph_stab_ros.evaluate', bag, '--inject', '1'],
        env={**os.environ, **LOCALES[locale]}, stderr=subprocess.PIPE, check=False)
    assert done.returncode == 1 and b'Traceback' not in done.stderr


@pytest.mark.parametrize('stream', ['stdout', 'stderr'])
def test_a_stream_may_be_closed(tmp_path, stream):
    """As jobs without a terminal have it."""
    bag = write_bag(tmp_path / 'bag', turning_spheres(3)[0])
    number = {'stdout': 1, 'stderr': 2}[stream]
    assert subprocess.run(
        [sys.executable, '-m', 'sph_stab_ros.replay', bag, '--trajectory', tmp_path / 'out.tum'],
        preexec_fn=lambda: os.close(number), check=False).returncode == 0
    assert len((tmp_path / 'out.tum').read_text().splitlines()) == 3


@pytest.mark.skipif(not os.path.exists('/dev/full'), reason='there is no /dev/full')
def test_output_without_room_ends_with_one_line(tmp_path):
    """That of the tool itself; its files are whole."""
    bag = write_bag(tmp_path / 'bag', turning_spheres(3)[0])
    with open('/dev/full', 'w') as full:
        done = subprocess.run(
            [sys.executable, '-m', 'sph_stab_ros.replay', bag], stdout=full,
            stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == 'replay: [Errno 28] No space left on device\n'
