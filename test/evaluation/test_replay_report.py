# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The page of a replay: all that it shows is inside, and what it says is so."""

from base64 import b64decode
from html.parser import HTMLParser
import sys

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sph_stab_ros.evaluation.replay_log import MOST_THUMBNAILS, ReplayLog
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.replay import main
from sph_stab_ros.stabilization.stabilized_frame import StabilizedFrame
from sph_stab_ros.tracking.base import TrackingStatus

OUTSIDE = {'src', 'href', 'data', 'action', 'poster', 'srcset'}


class Page(HTMLParser):
    """What stands in a page: text, tags, and what is loaded."""

    def __init__(self, text):
        super().__init__()
        self.words, self.tags, self.loaded = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        """Note a tag."""
        self.tags.append(tag)
        self.loaded += [value for name, value in attrs if name in OUTSIDE]

    def handle_data(self, data):
        """Note a text."""
        self.words.append(data)


def frames_of(R_world_camera, image):
    """Return StabilizedFrames, ten a second."""
    return [StabilizedFrame(Frame(image, number * NS_PER_S // 10), R, TrackingStatus.OK,
                            covariance=np.eye(3) * np.deg2rad(0.1) ** 2)
            for number, R in enumerate(R_world_camera)]


@pytest.mark.parametrize('count', [1, 5, 8, 9, 40, 100])
def test_thumbnails_are_few_and_evenly_spread(count):
    """However many frames there are; the first one is among them."""
    log = ReplayLog()
    for frame in frames_of(Rotation.identity(count), np.zeros((64, 128, 3), np.uint8)):
        log(frame)
    times_s = [time_s for time_s, *_ in log.thumbnails]
    assert times_s[0] == 0
    assert min(count, MOST_THUMBNAILS // 2) <= len(times_s) <= MOST_THUMBNAILS
    assert np.ptp(np.diff(times_s)) < 1e-9 if len(times_s) > 1 else True
    assert log.time_s[-1] - times_s[-1] <= np.diff(times_s).max(initial=0)


def test_thumbnails_show_the_sphere_as_recorded_and_as_shown(turning):
    """Turned back, all stabilised ones are alike."""
    images, R_world_camera = turning
    log = ReplayLog()
    for image, R in zip(images, R_world_camera):
        log(*frames_of([R], image))
    _, _, first = log.thumbnails[0]
    for _, recorded, stabilised in log.thumbnails[1:]:
        assert cv2.absdiff(stabilised, first).mean() < 0.3 * cv2.absdiff(recorded, first).mean()


def test_all_is_inside(turning_bag, tmp_path):
    """No network is needed, no script; pictures are whole; names are no markup."""
    pytest.importorskip('matplotlib')
    recording = tmp_path / '<script src=x>&"$title'
    recording.symlink_to(turning_bag)
    report = tmp_path / 'report.html'
    assert main([str(recording), '--report', str(report), '--smoothing', 'follow:3']) == 0
    page = Page(report.read_text())
    assert not {'script', 'link', 'iframe'} & {*page.tags}
    assert 'url(' not in report.read_text() and '//' not in ''.join(page.words)
    kinds = [one.partition(';base64,') for one in page.loaded]
    assert [kind for kind, *_ in kinds].count('data:image/png') == 4
    for kind, _, data in kinds:
        assert kind in ('data:image/png', 'data:image/jpeg')
        assert cv2.imdecode(np.frombuffer(b64decode(data), np.uint8), cv2.IMREAD_COLOR).size
    assert page.words.count(recording.name) == 2
    at = page.words.index('smoothing.time_constant_s')
    assert page.words[at + 1] == '3.0'
    assert 'estimator' not in page.words and '12 ok' in ''.join(page.words)


def test_what_is_missing_or_in_the_way_is_said(turning_bag, tmp_path, monkeypatch, capsys):
    """In one line, before anything is read."""
    report = tmp_path / 'report.html'
    report.write_text('of before')
    assert main([str(turning_bag), '--report', str(report)]) == 1
    assert capsys.readouterr().err == f'replay: {report} exists already; --force replaces it\n'
    monkeypatch.setitem(sys.modules, 'matplotlib', None)
    assert main([str(turning_bag), '--report', str(report), '--force']) == 1
    assert capsys.readouterr().err == (
        "replay: --report needs Matplotlib: pip install 'sph_stab_ros[plots]'\n")
    assert report.read_text() == 'of before'
