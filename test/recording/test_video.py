# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Video files: pixel aspect, rotation, times, damage; and the metadata of levelled ones."""

from fractions import Fraction
import struct

import cv2
import numpy as np
import pytest
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.recording.tilt import tilt_removed_in_camera, zenith_correction_applied
from sph_stab_ros.recording.video_writer import VideoWriter
from tiny_recordings import PERIOD_NS, stamps_of, START_NS, textured_sphere, write_video

av = pytest.importorskip('av')

IMAGE = textured_sphere()
COUNT = 30


def encode(path, images, pts=None, **container_options):
    """Write a video of BGR images directly, at multiples of 1/1000 s."""
    with av.open(str(path), 'w', options=container_options) as container:
        stream = container.add_stream('libx264', rate=25, options={'g': '5', 'bf': '0'})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = 'yuv420p'
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for index, image in enumerate(images):
            picture = av.VideoFrame.from_ndarray(image, format='bgr24')
            picture.pts = pts[index] if pts else 40 * index
            picture.time_base = Fraction(1, 1000)
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    return path


def difference(a, b):
    """Return the mean absolute difference of two images."""
    return np.abs(a.astype(int) - b).mean()


def test_times_may_be_irregular(tmp_path):
    """The container's times are the stamps, gaps included."""
    pts = [0, 40, 41, 100, 1500, 1533]
    frames = list(open_recording(encode(tmp_path / 'a.mkv', 6 * [IMAGE], pts)).frames())
    assert [frame.stamp_ns for frame in frames] == [ms * 10**6 for ms in pts]
    assert all(difference(frame.image, IMAGE) < 8 for frame in frames)


def test_what_is_written_is_read(turning, turning_video):
    """Pictures and times survive, up to the codec and to its clock of 90 kHz."""
    frames = list(open_recording(turning_video).frames())
    assert len(frames) == len(turning[0])
    stamps_ns = stamps_of(len(frames)) - START_NS
    assert np.abs(stamps_ns - [frame.stamp_ns for frame in frames]).max() <= 1e9 / 90000
    assert max(difference(f.image, image) for f, image in zip(frames, turning[0])) < 8


def test_repeated_and_backward_times_do_not_stop_the_writer(tmp_path):
    """A video needs increasing times; such pictures follow right behind."""
    stamps_ns = START_NS + PERIOD_NS * np.array((0, 1, 1, 0, 2))
    frames = list(open_recording(write_video(tmp_path / 'a.mp4', 5 * [IMAGE], stamps_ns)).frames())
    times_ns = [frame.stamp_ns for frame in frames]
    assert len(times_ns) == 5 and np.all(np.diff(times_ns) > 0)
    assert abs(times_ns[-1] - 2 * PERIOD_NS) <= 1e9 / 90000


def test_grey_and_resized_pictures_are_written_too(tmp_path):
    """The first picture decides on the size."""
    path = write_video(tmp_path / 'a.mp4', [IMAGE[..., 0], textured_sphere(128)[..., 0]])
    frames = list(open_recording(path).frames())
    assert [frame.image.shape for frame in frames] == 2 * [IMAGE.shape]


def test_odd_sizes_are_padded_to_even_ones(tmp_path):
    """H.264 needs them; the doubled row is not part of the sphere."""
    path = write_video(tmp_path / 'a.mp4', 3 * [textured_sphere(256)[:101, :155]])
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height) == (156, 102)


@pytest.mark.parametrize('error', [KeyboardInterrupt, ZeroDivisionError])
def test_what_was_written_before_an_error_can_be_read(tmp_path, error):
    """Somebody may have stopped a long run; the sphere's metadata are in as well."""
    path = tmp_path / 'a.mp4'
    with pytest.raises(error), VideoWriter(path, spheres=True) as video:
        for stamp_ns in stamps_of(5):
            video.write(IMAGE, int(stamp_ns))
        raise error
    assert len(list(open_recording(path).frames())) == 5
    assert (b'sv3d' in path.read_bytes()) == (error is KeyboardInterrupt)


def test_anamorphic_pictures_come_with_square_pixels(tmp_path):
    """In colour and in grey."""
    narrow = cv2.resize(IMAGE, (IMAGE.shape[1] * 3 // 4, IMAGE.shape[0]),
                        interpolation=cv2.INTER_AREA)
    path = tmp_path / 'a.mp4'
    with av.open(str(path), 'w') as container:
        stream = container.add_stream('libx264', rate=25, options={'crf': '5'})
        stream.height, stream.width = narrow.shape[:2]
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(narrow, format='bgr24')))
        container.mux(stream.encode())
    frame, = open_recording(path).frames()
    height, width = IMAGE.shape[0] * 3 // 4, IMAGE.shape[1] * 3 // 4
    assert frame.size_wh == (width, height) and frame.image.shape == (height, width, 3)
    small = cv2.resize(IMAGE, (width, height), interpolation=cv2.INTER_AREA)
    assert difference(frame.image, small) < 4
    assert difference(frame.grey(0), cv2.cvtColor(small, cv2.COLOR_BGR2GRAY)) < 4


def test_pixel_aspect_is_taken_out(shared_data):
    """A real clip of 640x322 whose pixels make it exactly 2:1."""
    recording = open_recording(shared_data / 'handheld_theta' / 'handheld_theta.mp4')
    frame = next(recording.frames())
    assert frame.image.shape == (320, 640, 3)
    assert recording.frame_count == 1202


def test_frames_that_the_container_only_claims_are_not_missed(shared_data, caplog):
    """A real clip that claims 123 frames of which 120 are shown: nothing is wrong with it."""
    recording = open_recording(shared_data / 'car_overpass' / 'car_overpass.mp4')
    stamps_ns = [frame.stamp_ns for frame in recording.frames()]
    assert len(stamps_ns) == 120 == recording.frame_count
    assert stamps_ns == [round(Fraction(k * 1001 * 10**9, 30000)) for k in range(120)]
    assert not caplog.records


@pytest.mark.parametrize('name, options', [
    ('a.mp4', {'movflags': 'faststart'}),
    ('a.mp4', {'movflags': 'frag_keyframe+empty_moov'}),
    ('a.mkv', {}),
], ids=['mp4', 'fragmented', 'mkv'])
def test_of_a_truncated_video_the_readable_part_is_read(tmp_path, caplog, name, options):
    """Frames up to the cut, in order, then one warning."""
    path = encode(tmp_path / name, [textured_sphere(seed=seed) for seed in range(COUNT)],
                  **options)
    data = path.read_bytes()
    path.write_bytes(data[:len(data) * 6 // 10])
    stamps_ns = [frame.stamp_ns for frame in open_recording(path).frames()]
    assert stamps_ns == [40 * 10**6 * k for k in range(len(stamps_ns))]
    assert COUNT * 0.6 - 5 <= len(stamps_ns) < COUNT
    assert len(caplog.records) == 1
    assert 'truncated' in caplog.text and f'{len(stamps_ns)} pictures' in caplog.text


def test_a_truncated_video_whose_index_was_at_the_end_is_refused(tmp_path):
    """Such a file cannot be decoded at all."""
    path = encode(tmp_path / 'a.mp4', COUNT * [IMAGE])
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(RecordingError, match='not a readable video: it was cut off before its '):
        open_recording(path)
    path.write_bytes(bytes(8) + path.read_bytes())
    with pytest.raises(RecordingError, match='not a readable video: Invalid data'):
        open_recording(path)


def test_damage_in_the_middle_costs_only_the_pictures_there(tmp_path):
    """Good frames before and after are given."""
    path = encode(tmp_path / 'a.mp4', [textured_sphere(seed=seed) for seed in range(COUNT)])
    data = bytearray(path.read_bytes())
    middle = data.index(b'mdat') + (data.index(b'moov') - data.index(b'mdat')) // 2
    data[middle:middle + 3000] = bytes(3000)
    path.write_bytes(data)
    stamps_ns = [frame.stamp_ns for frame in open_recording(path).frames()]
    assert COUNT - 6 <= len(stamps_ns) <= COUNT
    assert stamps_ns[0] == 0 and stamps_ns[-1] == 40 * 10**6 * (COUNT - 1)


def test_a_video_has_no_topics(turning_video):
    """Asking for one is a mistake."""
    with pytest.raises(RecordingError, match='no topic /image'):
        open_recording(turning_video, '/image')
    with pytest.raises(RecordingError, match='no topic /truth'):
        open_recording(turning_video).messages('/truth')


def theta_exif(flag, order):
    """Return EXIF data as Ricoh Theta cameras write them, with the zenith correction's flag."""
    def directory(start, tag, kind, value):
        """Return a directory with one entry, at start, and where it ends."""
        packed = struct.pack(order + ('HH' if kind == 3 else 'I'), *value)
        return (struct.pack(order + 'HHHI', 1, tag, kind, 1) + packed + bytes(4)), start + 18

    marker = b'II*\0' if order == '<' else b'MM\0*'
    ifd0, exif = directory(8, 0x8769, 4, (26,))
    exif_ifd, maker_note = directory(exif, 0x927C, 4, (44,))
    ricoh_ifd, theta = directory(maker_note + 8, 0x4001, 4, (70,))
    theta_ifd, _ = directory(theta, 0x0007, 3, (flag, 0))
    assert (exif, maker_note, theta) == (26, 44, 70)
    return (marker + struct.pack(order + 'I', 8) + ifd0 + exif_ifd + b'Ricoh\0\0\0' + ricoh_ifd
            + theta_ifd)


def with_user_data(path, exif):
    """Put EXIF data into an MP4 file, whose index is at its end, as Theta cameras do."""
    def box(name, content):
        return struct.pack('>I4s', 8 + len(content), name) + content

    data = path.read_bytes()
    start = data.index(b'moov') - 4
    path.write_bytes(data[:start] + box(
        b'moov', box(b'udta', box(b'@mod', b'RICOH THETA X') + box(b'RMKN', exif))
        + data[start + 8:]))
    return path


@pytest.mark.parametrize('order', '<>')
@pytest.mark.parametrize('flag', [0, 1])
def test_a_levelled_video_is_warned_about(tmp_path, caplog, flag, order):
    """Zenith correction in the camera, told by its own metadata."""
    path = with_user_data(encode(tmp_path / 'a.mp4', 3 * [IMAGE]), theta_exif(flag, order))
    assert len(list(open_recording(path).frames())) == 3
    assert [('zenith correction' in r.getMessage()) for r in caplog.records] == flag * [True]


def test_the_flag_is_found_in_what_a_real_theta_wrote(shared_data):
    """A Theta S photo without correction; its videos carry the same structure."""
    data = (shared_data / 'photos' / 'whdlgp_thetaS_5376.jpg').read_bytes()
    exif = bytearray(data[data.index(b'Exif\0\0') + 6:][:2**16])
    assert not zenith_correction_applied(bytes(exif))
    entry = exif.index(struct.pack('>HHI', 0x0007, 3, 1))
    exif[entry + 8:entry + 10] = b'\0\1'
    assert zenith_correction_applied(bytes(exif))


def test_damaged_metadata_say_nothing(tmp_path):
    """Random bytes in their place are no reason to fail."""
    rng = np.random.default_rng(0)
    exif = theta_exif(1, '<')
    for cut in range(len(exif)):
        path = tmp_path / f'{cut}.mp4'
        path.write_bytes(struct.pack('>I4s', 24 + cut, b'moov') + struct.pack(
            '>I4s', 16 + cut, b'udta') + struct.pack('>I4s', 8 + cut, b'RMKN') + exif[:cut])
        assert tilt_removed_in_camera(path) in (False, True)
        path.write_bytes(rng.bytes(100))
        assert not tilt_removed_in_camera(path)


@pytest.mark.parametrize('suffix', ['mp4', 'ts'])
def test_a_video_that_begins_without_a_key_picture_is_told_of(tmp_path, caplog, turning, suffix):
    """As one that was cut by others: a key picture is every fifth."""
    whole, cut = encode(tmp_path / f'whole.{suffix}', turning[0]), tmp_path / f'cut.{suffix}'
    with av.open(str(whole)) as source, av.open(str(cut), 'w') as target:
        stream = source.streams.video[0]
        copied = target.add_stream_from_template(stream)
        for number, packet in enumerate(source.demux(stream)):
            if number and packet.dts is not None:
                packet.stream = copied
                target.mux(packet)
    assert len(list(open_recording(whole).frames())) == len(turning[0]) and not caplog.records
    assert len(list(open_recording(cut).frames())) == len(turning[0]) - 5
    record, = caplog.records
    assert 'begins without a key picture: its first 0.160 s' in record.getMessage()
