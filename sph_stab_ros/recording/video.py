# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pictures out of video files, through PyAV."""

from collections import Counter
from collections.abc import Generator, Iterator
from functools import cached_property
import logging
from pathlib import Path
from typing import Any

from sph_stab_ros.config import NOT_JOINED
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.images.joined import tracks_of
from sph_stab_ros.images.picture_clock import PictureClock
from sph_stab_ros.images.picture_time import PictureTime
from sph_stab_ros.images.video.picture import side_data_of, tagged_colour, VideoPicture
from sph_stab_ros.recording.base import RecordingError, SkipLog, Stretch
from sph_stab_ros.recording.joined import joined
from sph_stab_ros.recording.picture_times import with_times, within
from sph_stab_ros.recording.pyav import av, url_of
from sph_stab_ros.recording.spherical import boxes_say, InBoxes, layout_of
from sph_stab_ros.recording.spherical_boxes import is_without_index
from sph_stab_ros.recording.telemetry import read_telemetry, stabilized_by, Telemetry
from sph_stab_ros.recording.tilt import tilt_removed_in_camera
from sph_stab_ros.recording.video_stream import PictureStream, Stamped

logger = logging.getLogger(__name__)

NO_INDEX = ('it was cut off before its index (moov) was written, which says where the pictures '
            'are; tools such as untrunc make one after another video of the same camera')


class VideoRecording:
    """
    A video file, or a stretch of it.

    Pictures come with square pixels and upright, as the container's pixel aspect and rotation
    say, in the colours that its tags say, and with the container's times, which need not be
    regular. A stream without any times has those of its rate, in the order of presentation. What
    the metadata say of stereo and of parts of the sphere is the Frames' layout. Two tracks, of a
    lens each, are joined as ``join`` says.
    """

    def __init__(self, path: Path, stretch: Stretch = Stretch(), join: str = NOT_JOINED) -> None:
        self.topics: dict[str, str] = {}
        self.image_topic: str | None = None
        self.path = path
        self._url = url_of(path)
        # Where the sound is that belongs to the pictures.
        self.sound_path: Path | None = path
        self.name = path.name
        self._stretch, self._join = stretch, join
        self._in_boxes = boxes_say(path)
        self._skip_log = SkipLog(self.name)
        with self._open() as container:
            pictures = self._pictures(container)
            stream, duration_s = pictures.stream, pictures.duration_s
            self.frame_count: int | None = stream.frames or None
            if duration_s and stream.average_rate:
                # Some containers count fields, or frames that an edit list hides.
                self.frame_count = stretch.share(
                    round(duration_s * stream.average_rate), duration_s)
        if tilt_removed_in_camera(path):
            logger.warning(
                '%s: its metadata say that the camera removed the tilt already (zenith '
                'correction): what is found is the rotation that is left in the pictures, not '
                "the camera's", self.name)
        if how := stabilized_by(path):
            logger.warning(
                '%s: its metadata say that the camera stabilised the pictures itself (%s): what '
                'is found is the rotation that is left in them, not what its gyro measured',
                self.name, how)

    @property
    def skipped(self) -> Counter[str]:
        """Count the pictures left out so far, by reason."""
        return self._skip_log.counts

    @cached_property
    def telemetry(self) -> Telemetry | None:
        """Return what the camera measured itself, if that is in the file's metadata."""
        return read_telemetry(self.path)

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Raise RecordingError: a video has no topics."""
        raise RecordingError(f'{self.path} is not a bag and has no topic {topic}')

    def frames(self) -> Generator[Frame, None, None]:
        """Yield the Frames as they are decoded."""
        self._skip_log = SkipLog(self.name)
        if self._join == NOT_JOINED:
            yield from self._track(0)
        else:
            yield from joined(self._track(0), self._track(1), self._join, self._skip_log)

    def _track(self, number: int) -> Iterator[Frame]:
        """Yield the Frames of one of the tracks that are used."""
        with self._open() as container:
            pictures = self._pictures(container, number)
            if number == 0:
                self._say_what_is_assumed(pictures)
            stamped = pictures.stamped(self._stretch.start_ns)
            if stamped is not None:
                yield from self._frames(pictures, stamped)
                return
        with self._open() as container:
            pictures = self._pictures(container, number)
            yield from self._frames(pictures, pictures.stamped())

    def _pictures(self, container: 'av.container.InputContainer', number: int = 0
                  ) -> PictureStream:
        stream = tracks_of(container, self._join)[number]
        return PictureStream(container, stream, self.name, self._skip_log)

    def _frames(self, pictures: PictureStream, stamped: Stamped | None) -> Iterator[Frame]:
        assert stamped is not None, 'from the beginning there is no key picture missing'
        first_ns, from_there = stamped
        clock = PictureClock(round(NS_PER_S / pictures.rate))
        timed = with_times(self.name, from_there, clock)
        for times, picture in within(self.name, timed, self._stretch, first_ns):
            yield self._frame(picture, times, pictures.stream)

    def _frame(self, picture: 'av.VideoFrame', times: PictureTime, stream: 'av.VideoStream'
               ) -> Frame:
        """Return the Frame of a decoded picture."""
        side_data = side_data_of(picture)
        colour = tagged_colour(picture, stream.codec_context)
        source = VideoPicture(picture, colour, stream.sample_aspect_ratio,
                              side_data.get('DISPLAYMATRIX'))
        layout = refusal = None
        try:
            # Of one lens there is no layout: projection says what two show.
            if self._join == NOT_JOINED:
                layout = layout_of(side_data, source.size_wh, self._in_boxes)
        except RecordingError as error:
            refusal = RecordingError(f'{self.name}: {error}')
        return Frame(source, times.stamp_ns, times=times, layout=layout, colour=colour,
                     refusal=refusal)

    def _say_what_is_assumed(self, pictures: PictureStream) -> None:
        rate = float(pictures.rate)
        if not pictures.has_times:
            logger.warning('%s has no times: %g pictures a second are assumed', self.name, rate)
        elif not pictures.has_presentation_times:
            logger.warning('%s has no times of presentation: the pictures are taken in order, at '
                           '%g a second', self.name, rate)

    def _open(self) -> 'av.container.InputContainer':
        try:
            container = av.open(self._url, metadata_errors='replace')
        except OSError as error:
            raise RecordingError(f'{self.path} cannot be read: {error.strerror}') from None
        except av.FFmpegError as error:
            reason = NO_INDEX if is_without_index(self.path) else error.strerror
            raise RecordingError(f'{self.path} is not a readable video: {reason}') from None
        tracks, why = tracks_of(container, self._join), ''
        if not tracks:
            why = 'has no video stream'
        elif self._join != NOT_JOINED and len(tracks) < 2:
            why = 'has no second video track of the same size to join'
        # So FFmpeg tells an unknown codec, and ends the process where it is to decode that.
        elif any(track.codec_context is None for track in tracks):
            why = 'has pictures of a codec that FFmpeg does not know'
        if why:
            container.close()
            raise RecordingError(f'{self.path} {why}')
        return container


class PipedVideo(VideoRecording):
    """
    A video that comes through standard input, or through a pipe at a path, and is read once.

    Most MP4 files cannot, since what is in them stands at their ends. Of the sphere it is known
    what is said with the pictures themselves; sound is left out.
    """

    def __init__(self, path: Path | None = None, stretch: Stretch = Stretch()) -> None:
        self.topics, self.image_topic, self.frame_count = {}, None, None
        self.path, self.sound_path = path or Path('standard input'), None
        self.name, self._url = self.path.name, url_of(path) if path else 'pipe:0'
        self._stretch, self._join = stretch, NOT_JOINED
        self._in_boxes = InBoxes()
        self._skip_log = SkipLog(self.name)
        self._is_read = False

    @cached_property
    def telemetry(self) -> None:
        """Return nothing: a pipe is read once."""

    def frames(self) -> Generator[Frame, None, None]:
        """Yield the Frames as they are decoded; RecordingError where they have been before."""
        if self._is_read:
            raise RecordingError(f'{self.name} can be read only once')
        self._is_read = True
        with self._open() as container:
            pictures = self._pictures(container)
            self._say_what_is_assumed(pictures)
            yield from self._frames(pictures, pictures.stamped())
