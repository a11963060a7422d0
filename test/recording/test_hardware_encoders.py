# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Encoders in hardware: used where they open, said and done without where they do not.

Without a card the way of one that opens is gone with x264 in its place, given pictures as cards
take them.
"""

import cv2
import pytest

from sph_stab_ros.config import encoder as config
from sph_stab_ros.recording import open_recording
from sph_stab_ros.replay import main

av = pytest.importorskip('av')
encoders = pytest.importorskip('sph_stab_ros.images.video.encoders')


def film(recording, out, *args):
    """Write a video; return its Frames."""
    assert main([str(recording), str(out), '--max-frames', '4', *map(str, args)]) == 0
    return list(open_recording(out).frames())


@pytest.fixture
def card(monkeypatch):
    """Let x264 stand in for a card, and return its name; it gets NV12, as many cards do."""
    monkeypatch.setitem(config.HARDWARE_CODECS, 'libx264', config.H264)
    monkeypatch.setitem(config.HARDWARE_QUALITY, '', ('crf', {'preset': 'ultrafast'}))
    monkeypatch.setattr(config, 'HARDWARE_ENCODERS', ('libx264',))

    def only_nv12(*args):
        encoders.usable_format(*args)
        return 'nv12'
    monkeypatch.setattr('sph_stab_ros.recording.video_writer.usable_format', only_nv12)
    return 'libx264'


def test_one_that_opens_encodes(turning_video, tmp_path, card, capfd):
    """Told the quality, and given the same values, in the order that it takes them in."""
    args = '--quality', '33'
    software = film(turning_video, tmp_path / 'a.mp4', *args, '--preset', 'ultrafast')
    hardware = film(turning_video, tmp_path / 'b.mp4', *args, '--encoder', card)
    assert capfd.readouterr().err == ''
    assert b'crf=33.0' in (tmp_path / 'b.mp4').read_bytes()
    for a, b in zip(software, hardware, strict=True):
        assert a.stamp_ns == b.stamp_ns and not cv2.absdiff(a.image, b.image).any()


@pytest.mark.parametrize('name, software', [
    ('h264_nvenc', 'libx264'), ('h264_qsv', 'libx264'), ('hevc_vaapi', 'libx265'),
    ('hevc_nvenc', 'libx265'), ('av1_amf', 'libsvtav1')])
def test_one_that_does_not_open_is_done_without(turning_video, tmp_path, capfd, name, software):
    """With a line that names both; the codec and the picture are what was asked for."""
    if software not in av.codecs_available:
        pytest.skip(f'PyAV has no {software}')
    try:
        encoders.usable_format(name, (256, 128), {})
    except encoders.EncoderError:
        pass
    else:
        pytest.skip(f'{name} opens here')
    found = film(turning_video, tmp_path / 'found.mp4', '--encoder', name)
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 1 and f'{name} cannot be used here: ' in lines[0]
    assert lines[0].endswith(f'; {software} encodes')
    codec = name.partition('_')[0].replace('hevc', 'h265')
    expected = film(turning_video, tmp_path / 'expected.mp4', '--codec', codec)
    for a, b in zip(expected, found, strict=True):
        assert not cv2.absdiff(a.image, b.image).any()


@pytest.mark.parametrize('name, is_deep, reason', [
    ('h264_none', False, 'it is not in this PyAV'), ('mjpeg', True, '10 bits from memory')])
def test_why_one_cannot_be_used_is_said(name, is_deep, reason):
    """In a few words."""
    with pytest.raises(encoders.EncoderError, match=reason):
        encoders.usable_format(name, (256, 128), {}, is_deep)


def test_an_encoder_is_asked_in_a_format_that_it_takes():
    """Of ten bits where there are such."""
    assert encoders.usable_format('libx264', (256, 128), {}) == 'yuv420p'
    assert encoders.usable_format('libx264', (256, 128), {}, True) == 'yuv420p10le'


@pytest.mark.parametrize('name', config.HARDWARE_ENCODERS)
def test_each_is_told_a_quality_and_has_a_codec(name):
    """That of the codec where none is given."""
    usual, good = config.EncoderConfig(encoder=name), config.EncoderConfig(encoder=name, quality=9)
    assert usual.codec_for(False) == usual.codec_for(True)
    assert str(config.DEFAULTS[usual.codec_for(False)][0]) in usual.hardware_options.values()
    assert '9' in good.hardware_options.values()


@pytest.mark.parametrize('args, reason', [
    (('--encoder', 'h264_nvnec'), 'encoder is one of h264_nvenc, '),
    (('--encoder', 'hevc_nvenc', '--codec', 'h264'), 'encoder hevc_nvenc is none of h264')])
def test_a_wrong_call_ends_with_2_and_one_line(turning_video, tmp_path, capsys, args, reason):
    """Nothing is begun."""
    with pytest.raises(SystemExit) as end:
        main([str(turning_video), str(tmp_path / 'out.mp4'), *args])
    error = capsys.readouterr().err
    assert end.value.code == 2 and reason in error and error.count('\n') == 1
