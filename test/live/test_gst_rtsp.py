# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Streams of a server that is not FFmpeg's: GStreamer's, where Debian's package is installed."""

from contextlib import contextmanager
import logging
from pathlib import Path
import subprocess
import time

import numpy as np
import pytest

pytest.importorskip('av')
from sph_stab_ros.live.address import address_of  # noqa: E402, I100
from sph_stab_ros.live.source import LiveSource  # noqa: E402

SERVER = Path(__file__).resolve().parents[1] / 'support' / 'gst_rtsp_server.py'
TIMEOUT_S = 30.
STREAMS = {
    'h264': ('x264enc tune=zerolatency speed-preset=ultrafast key-int-max=15', 'rtph264pay'),
    'hevc': ('x265enc tune=zerolatency speed-preset=ultrafast key-int-max=15', 'rtph265pay'),
    'vp8': ('vp8enc deadline=1', 'rtpvp8pay'), 'mjpeg': ('jpegenc', 'rtpjpegpay')}

pytestmark = pytest.mark.slow


@contextmanager
def serving(codec):
    """Serve a stream by the system's Python; give its address."""
    with subprocess.Popen(['/usr/bin/python3', str(SERVER), *STREAMS[codec]], text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE) as server:
        try:
            port = server.stdout.readline().strip()
            if not port:
                pytest.skip('no RTSP server of GStreamer: '
                            + server.communicate()[1].strip().splitlines()[-1])
            yield f'rtsp://127.0.0.1:{port}/sphere'
        finally:
            server.kill()


@pytest.mark.parametrize('options', ['', 'rtsp_flags=0,rtsp_transport=udp'], ids=['tcp', 'udp'])
@pytest.mark.parametrize('codec', STREAMS)
def test_pictures_come_with_the_clock_of_the_server(codec, options):
    pictures, refused = [], []
    with serving(codec) as url:
        source = LiveSource(address_of(url, options), pictures.append,
                            logging.getLogger('live'), refused.append)
        source.start()
        end_s = time.monotonic() + TIMEOUT_S
        # It tells its clock every few seconds.
        while source.state.clock != 'sender' and time.monotonic() < end_s:
            time.sleep(0.05)
        state = source.state
        source.close()
    assert state[:4] == ('connected', '', codec, (256, 128)) and state.clock == 'sender'
    assert (np.diff([one.stamp_ns for one in pictures]) > 0).all()
    assert {one.reason for one in refused} <= {'no key picture'}
