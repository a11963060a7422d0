# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""A headset that is none: IWER, an emulator of WebXR, which comes by npm for these tests alone."""

from pathlib import Path
import shutil
import subprocess
import tarfile
import tempfile

import pytest

VERSION = '2.5.0'
CACHE = Path(__file__).resolve().parents[2] / 'results' / f'iwer-{VERSION}.js'
MEMBER = 'package/build/iwer.min.js'
TIMEOUT_S = 60
# Worn by nobody: it looks ahead. The two eyes are beside each other on the page.
WORN = """
    window.worn = new IWER.XRDevice(IWER.metaQuest3, {stereoEnabled: true, visibilityMask: null});
    window.worn.installRuntime({forceInstall: true});
"""


def emulator():
    """Return a script that gives a page a headset, ``worn``, or skip the test."""
    if not CACHE.exists():
        fetch()
    return CACHE.read_text() + WORN


def fetch():
    """Bring the emulator here, or skip the test."""
    npm = shutil.which('npm') or pytest.skip('there is no npm to bring the emulator of a headset')
    CACHE.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=CACHE.parent) as folder:
        try:
            packed = subprocess.run(
                [npm, 'pack', f'iwer@{VERSION}'], cwd=folder, timeout=TIMEOUT_S, text=True,
                capture_output=True)
        except subprocess.TimeoutExpired:
            pytest.skip('npm does not bring the emulator of a headset')
        if packed.returncode:
            pytest.skip(f'npm does not bring the emulator of a headset: {packed.stderr[:200]}')
        with tarfile.open(Path(folder) / f'iwer-{VERSION}.tgz') as archive:
            script = archive.extractfile(MEMBER).read()
        # Whole, or not at all.
        partial = Path(folder) / CACHE.name
        partial.write_bytes(script)
        partial.replace(CACHE)
