# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Telemetry, damaged in every way: what is whole is read, or a line says what is wrong."""

from functools import cache
from pathlib import Path
import re
import tempfile

from fuzzing import examples, mutated, tried
from hypothesis import given, strategies as st
import numpy as np
import pytest
from sph_stab_ros.recording import RecordingError
from sph_stab_ros.recording.telemetry import camm, gpmf, read_telemetry, stabilized_by
from telemetry_files import (
    body_forces, body_rates, camm as camm_of, gopro, gopro_settings, insta360, orientation,
    with_track)
from tiny_recordings import turning_spheres, write_video

pytest.importorskip('av')

T = np.arange(0, 3, 0.05)
MOTION = T, body_rates(T), body_forces(T)


@cache
def folder():
    """Return a folder for videos, as long as the tests run."""
    return tempfile.TemporaryDirectory(prefix='fuzz_')


@cache
def files():
    def video():
        return write_video(Path(folder().name) / 'video.mp4', turning_spheres(2, 128)[0])
    return (
        with_track(video(), b'gpmd', gopro(*MOTION), 1000, gopro_settings(True)).read_bytes(),
        with_track(video(), b'camm', camm_of(*MOTION, orientation(T))).read_bytes(),
        video().read_bytes() + insta360(*MOTION),
        video().read_bytes() + insta360(*MOTION, raw=True, places=True))


def fields_of(data):
    """Return where records begin, about: keys of GPMF, boxes, and the end of a trailer."""
    return [match.start() for match in re.finditer(rb'[A-Za-z][A-Za-z0-9]{3}', data)] + [
        len(data) - back for back in (34, 38, 72, 76, 100)]


def check(found):
    for series in (found.rates_rad_s, found.forces_m_s2, found.orientations_rad):
        if series is not None:
            stamps_ns, vectors = series
            assert vectors.shape == (len(stamps_ns), 3) and len(stamps_ns)
            assert np.isfinite(vectors).all() and (np.diff(stamps_ns) > 0).all()


@given(st.deferred(lambda: mutated(*files(), hot=fields_of)))
@examples(60)
def test_files_with_telemetry(data):
    path = Path(folder().name) / 'input.mp4'
    with tried('telemetry', data):
        path.write_bytes(data)
        assert '\n' not in stabilized_by(path)
        try:
            found = read_telemetry(path)
        except RecordingError as error:
            assert str(error)
        else:
            if found is not None:
                check(found)


@given(st.lists(st.tuples(st.floats(-1e9, 1e9), st.floats(0, 1e9), mutated(
    *(payload for _, payload in (*gopro(*MOTION), *gopro(*MOTION, stamps=False))),
    hot=fields_of)), max_size=4))
@examples(100)
def test_payloads_of_gpmf(payloads):
    with tried('gpmf', b''.join(data for *_, data in payloads)):
        check(gpmf.read(payloads))


PACKETS = [packet for _, packet in camm_of(*(one[:1] for one in MOTION), orientation(T[:1]))]


@given(st.lists(st.tuples(st.floats(-1e9, 1e9), st.just(0.), mutated(*PACKETS)), max_size=20))
@examples(50)
def test_packets_of_camm(packets):
    with tried('camm', b''.join(data for *_, data in packets)):
        check(camm.read(packets))
