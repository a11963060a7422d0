# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Two lenses' pictures, as two tracks of a video or two topics of a bag, are read as one."""

import numpy as np
from projection_pictures import picture_of
import pytest
from scipy.spatial.transform import Rotation
from sph_stab_ros.config import (
    DUAL_FISHEYE, FisheyeConfig, GOPRO_MAX, LEFT_RIGHT, LensConfig, StabilizerConfig, TOP_BOTTOM)
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.projection_factory import projection_of
from sph_stab_ros.geometry.trajectory import read_tum
from sph_stab_ros.images.image_error import ImageError
from sph_stab_ros.images.joined import JoinedPicture, MAX_APART_NS, Pairing
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.recording.bag_writer import BagWriter
from sph_stab_ros.replay import main as replay
from tiny_recordings import stamps_of, textured_sphere

av = pytest.importorskip('av')
videos = pytest.importorskip('tiny_videos')

COUNT, SIZE_WH = 12, (64, 48)
TOPICS = '/front/image', '/rear/image'
AXES = {LEFT_RIGHT: 1, TOP_BOTTOM: 0}


def pictures_of(track, count=COUNT, size_wh=SIZE_WH):
    """Return pictures that tell of which track they are, and the how many-th."""
    width, height = size_wh
    images = [np.full((height, width, 3), (40 + 10 * number, 60 + 60 * track, 90), np.uint8)
              for number in range(count)]
    return [videos.bgr_frame(image) for image in images]


def video(path, pts_ms=None, sizes_wh=(SIZE_WH, SIZE_WH)):
    """Write a video of a track of each size; return the path."""
    counts = [COUNT if pts_ms is None else len(times) for times in pts_ms or sizes_wh]
    tracks = [pictures_of(track, count, size_wh)
              for track, (count, size_wh) in enumerate(zip(counts, sizes_wh))]
    return videos.encode_tracks(path, tracks, pts_ms, {**videos.LOSSLESS, 'g': '4'})


def times_ms(recording):
    """Return the times of a recording's pictures."""
    return [round(frame.stamp_ns / 1e6) for frame in recording.frames()]


@pytest.mark.parametrize('join', AXES)
def test_two_tracks_are_one_picture(tmp_path, join):
    path = video(tmp_path / 'a.mp4')
    frames = list(open_recording(path, join=join).frames())
    with av.open(str(path)) as container:
        tracks = [list(container.decode(container.streams.video[0]))]
    with av.open(str(path)) as container:
        tracks.append(list(container.decode(container.streams.video[1])))
    assert len(frames) == COUNT
    for frame, *pair in zip(frames, *tracks):
        parts = [picture.to_ndarray(format='bgr24') for picture in pair]
        expected = np.concatenate(parts, axis=AXES[join])
        assert frame.image.shape == expected.shape
        assert frame.size_wh == expected.shape[1::-1]
        assert np.abs(frame.image.astype(int) - expected).max() <= 2
        assert frame.grey().shape == expected.shape[:2]
        assert frame.stamp_ns == round(pair[0].time * NS_PER_S)


def test_without_asking_it_is_the_first_track_alone(tmp_path):
    frames = list(open_recording(video(tmp_path / 'a.mp4')).frames())
    assert len(frames) == COUNT
    assert {frame.size_wh for frame in frames} == {SIZE_WH}


def test_what_one_lens_lacks_is_left_out_and_no_other_takes_its_place(tmp_path):
    whole = 40 * np.arange(COUNT)
    lacks = np.delete(whole, 5)
    for pts_ms in ((whole, lacks), (lacks, whole)):
        recording = open_recording(video(tmp_path / 'a.mp4', pts_ms), join=LEFT_RIGHT)
        assert times_ms(recording) == lacks.tolist()
        assert sum(recording.skipped.values()) == 1


def test_a_stretch_holds_the_same_pictures(tmp_path):
    path = video(tmp_path / 'a.mp4')
    stretch = open_recording(path, start_s=0.2, end_s=0.4, join=LEFT_RIGHT)
    assert times_ms(stretch) == [200, 240, 280, 320, 360]
    whole = {frame.stamp_ns: frame.image
             for frame in open_recording(path, join=LEFT_RIGHT).frames()}
    for frame in stretch.frames():
        np.testing.assert_array_equal(frame.image, whole[frame.stamp_ns])


@pytest.mark.parametrize('sizes_wh', [(SIZE_WH,), (SIZE_WH, (32, 16))])
def test_a_file_without_a_second_track_of_its_size_is_refused(tmp_path, sizes_wh):
    path = video(tmp_path / 'a.mp4', sizes_wh=sizes_wh)
    with pytest.raises(RecordingError, match='no second video track') as error:
        open_recording(path, join=LEFT_RIGHT)
    assert str(path) in str(error.value)


def test_a_preview_of_another_size_between_them_is_no_lens(tmp_path):
    path = video(tmp_path / 'a.mp4', sizes_wh=(SIZE_WH, (32, 16), SIZE_WH))
    frame = next(open_recording(path, join=LEFT_RIGHT).frames())
    assert frame.size_wh == (2 * SIZE_WH[0], SIZE_WH[1])
    # The third track, which is the greenest.
    assert frame.image[24, 100, 1] > frame.image[24, 30, 1] + 80


def test_two_topics_are_one_picture(tmp_path):
    rng = np.random.default_rng(0)
    images = [[np.full((48, 64, 3), rng.integers(256), np.uint8) for _ in range(COUNT)]
              for _ in TOPICS]
    with BagWriter(tmp_path / 'bag') as bag:
        for number, stamp_ns in enumerate(stamps_of(COUNT)):
            for topic, one, late_ns in zip(TOPICS, images, (0, 2_000_000)):
                if (topic, number) != (TOPICS[1], 3):
                    bag.write_jpeg(topic, int(stamp_ns) + late_ns, 'rig', one[number])
    recording = open_recording(tmp_path / 'bag', ','.join(TOPICS), join=TOP_BOTTOM)
    frames = list(recording.frames())
    expected = [number for number in range(COUNT) if number != 3]
    assert [frame.stamp_ns for frame in frames] == stamps_of(COUNT)[expected].tolist()
    assert recording.skipped == {'one lens only': 1}
    for number, frame in zip(expected, frames):
        assert frame.frame_id == 'rig'
        both = np.vstack([one[number] for one in images])
        assert np.abs(frame.image.astype(int) - both).max() <= 4
    for topics in (None, TOPICS[0], ','.join((*TOPICS, *TOPICS))):
        with pytest.raises(RecordingError, match='--image-topic A,B'):
            open_recording(tmp_path / 'bag', topics, join=TOP_BOTTOM)


def test_pictures_of_one_moment_are_paired_whatever_is_lost():
    """By turns and by chance: each pair is of one moment, and all that could be paired are."""
    rng = np.random.default_rng(0)
    period_ns = 2 * MAX_APART_NS
    for _ in range(20):
        kept = rng.random((2, 60)) > 0.2
        shift_ns = int(rng.integers(-MAX_APART_NS + 1, MAX_APART_NS)) // 2
        arrivals = sorted(
            (number + rng.uniform(0, 3), number, which) for number in range(60)
            for which in (0, 1) if kept[which, number])
        # Each in its own order.
        queues = [[number for number in range(60) if kept[which, number]] for which in (0, 1)]
        pairing, pairs = Pairing(), []
        for *_, which in arrivals:
            number = queues[which].pop(0)
            pair = pairing.add(which, number * period_ns + which * shift_ns, number)
            pairs += [] if pair is None else [pair]
        assert all(a == b for a, b in pairs)
        assert [a for a, _ in pairs] == np.flatnonzero(kept.all(axis=0)).tolist()
        assert pairing.left_out == kept.sum() - 2 * len(pairs)


def test_pictures_that_do_not_fit_each_other_are_no_picture():
    joined = JoinedPicture(np.zeros((4, 6, 3), np.uint8), np.zeros((4, 6), np.uint8), LEFT_RIGHT)
    with pytest.raises(ImageError, match='different sizes'):
        joined.image
    assert joined.grey().shape == (4, 12)


LENSES = FisheyeConfig(
    640, 320, fov_deg=200., front=LensConfig(159.5, 159.5, 140., 0., 0., 0., 0., 0.),
    rear=LensConfig(479.5, 159.5, 140., 0., 0., 180., 0., 0.))
CAMERAS = {
    'two fisheyes': (LEFT_RIGHT, (640, 320), StabilizerConfig(
        projection=DUAL_FISHEYE, fisheye=LENSES), [
            '-p', 'fisheye.width:=640', '-p', 'fisheye.height:=320',
            '-p', 'fisheye.fov_deg:=200.0',
            *(argument for lens, u, yaw in (('front', 159.5, 0.), ('rear', 479.5, 180.))
              for name, value in (
                  ('center_u_px', u), ('center_v_px', 159.5), ('radius_px', 140.), ('k1', 0.),
                  ('k2', 0.), ('yaw_deg', yaw), ('roll_deg', 0.))
              for argument in ('-p', f'fisheye.{lens}.{name}:={value}'))]),
    'GoPro Max': (TOP_BOTTOM, (512, 336), StabilizerConfig(projection=GOPRO_MAX), [])}


@pytest.mark.parametrize('camera', CAMERAS)
def test_the_rotation_is_found_in_two_tracks(tmp_path, camera):
    """Of rendered pictures, in which a pixel sees half a degree."""
    join, size_wh, config, arguments = CAMERAS[camera]
    projection, world = projection_of(size_wh, config), textured_sphere(1024)
    truth = Rotation.from_euler('YX', [(2. * n, 0.7 * n) for n in range(8)], degrees=True)
    tracks = [], []
    for R in truth:
        for track, part in zip(tracks, np.split(picture_of(projection, world, R), 2, AXES[join])):
            track.append(videos.bgr_frame(np.ascontiguousarray(part)))
    path = videos.encode_tracks(tmp_path / 'a.mp4', tracks, options={'crf': '10'})
    out = tmp_path / 'a.tum'
    assert replay([str(path), '--join', join, '--projection', config.projection, *arguments,
                   '--trajectory', str(out)]) == 0
    found = read_tum(out).rotations
    errors_deg = np.rad2deg((truth[0].inv() * truth * found.inv()).magnitude())
    assert len(errors_deg) == len(truth)
    assert errors_deg.max() < 0.2
    # One track alone is another picture, and refused.
    assert replay([str(path), '--projection', config.projection, *arguments]) == 1
