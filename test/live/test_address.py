# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What texts of sources and their options mean."""

import pytest
from sph_stab_ros.live.address import address_of, Kind, SourceError


@pytest.mark.parametrize('text, kind', [
    ('/dev/video0', Kind.DEVICE), ('/dev/v4l/by-id/usb-RICOH-video-index0', Kind.DEVICE),
    ('rtsp://camera/live', Kind.STREAM), ('RTMP://camera/live', Kind.STREAM),
    ('udp://@:5000', Kind.STREAM), ('http://camera/mjpg', Kind.STREAM), ('-', Kind.PIPE),
    ('pipe:0', Kind.PIPE)])
def test_kinds(text, kind):
    assert address_of(text).kind is kind


def test_a_file_is_one_that_there_is(tmp_path):
    path = tmp_path / 'ride: 1.mp4'
    path.touch()
    for text in str(path), f'file://{path}':
        address = address_of(text)
        assert (address.kind, address.url) == (Kind.FILE, f'file:{path}')
    with pytest.raises(SourceError, match='there is no file'):
        address_of(str(tmp_path / 'none.mp4'))


@pytest.mark.parametrize('text, shown', [
    ('rtsp://root:pa55@camera:554/a?b=c@d', 'rtsp://root:***@camera:554/a?b=c@d'),
    ('rtsp://root:pa:55@camera/', 'rtsp://root:***@camera/'),
    ('rtsp://root@camera/', 'rtsp://root@camera/'),
    ('rtsp://camera/a:b@c', 'rtsp://camera/a:b@c')])
def test_a_password_is_given_to_nobody_but_the_camera(text, shown):
    address = address_of(text)
    assert (address.name, address.url) == (shown, text)


def test_options_of_the_user_win():
    address = address_of('rtsp://camera/', 'rtsp_flags=none, rtsp_transport=udp')
    assert address.choices[0]['rtsp_flags'] == 'none'
    assert address.choices[0]['rtsp_transport'] == 'udp'
    assert address_of('udp://@:5000').format == 'mpegts'
    assert address_of('udp://@:5000', 'format=h264').format == 'h264'


def test_of_a_device_the_best_is_tried_first_unless_the_user_chooses():
    assert [one.get('input_format') for one in address_of('/dev/video0').choices] == [
        'mjpeg', 'h264', None]
    assert all(one['framerate'] == '30'
               for one in address_of('/dev/video0', 'framerate=30').choices)
    chosen, = address_of('/dev/video0', 'video_size=1920x960,framerate=30').choices
    assert chosen == {'video_size': '1920x960', 'framerate': '30'}


@pytest.mark.parametrize('options', ['framerate', '=30', 'a=1,b'])
def test_what_is_no_option_is_told(options):
    with pytest.raises(SourceError, match='is not NAME=VALUE'):
        address_of('/dev/video0', options)
