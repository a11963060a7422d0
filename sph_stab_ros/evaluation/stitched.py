# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
A recording of circles, of faces of a cube, of two eyes or a part of the sphere, read as spheres.

Injected rotations and figures need those. Circles are stitched, that is joined into one sphere, of
two eyes one is taken; nothing is turned or stabilised here.
"""

from collections import Counter
from collections.abc import Generator
from contextlib import suppress
import logging

from sph_stab_ros.config import MIN_WIDTH, StabilizerConfig
from sph_stab_ros.geometry.projection_factory import projection_of, ProjectionError
from sph_stab_ros.images.appearance_watch import PictureWatch
from sph_stab_ros.images.codec import ImageError
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.images.sphere import as_sphere, config_for, stitched
from sph_stab_ros.recording.base import Recording, SkipLog
from sph_stab_ros.recording.telemetry import Telemetry

logger = logging.getLogger(__name__)


class Stitched:
    """
    A Recording whose frames are equirectangular, if they were not already.

    Parameters
    ----------
    recording
    config
        What its pictures are.
    watch : PictureWatch, optional
        Looks at them; one of its own by default.

    """

    def __init__(self, recording: Recording, config: StabilizerConfig,
                 watch: PictureWatch | None = None) -> None:
        self._recording = recording
        self._config = config
        self._skip_log = SkipLog(recording.name)
        self._watch = watch or PictureWatch(config)
        self.name = recording.name
        self.topics = recording.topics
        self.image_topic = recording.image_topic
        self.frame_count = recording.frame_count
        self.messages = recording.messages

    @property
    def skipped(self) -> Counter[str]:
        """Count the pictures left out so far, by reason."""
        return Counter(self._recording.skipped) + self._skip_log.counts

    @property
    def telemetry(self) -> Telemetry | None:
        """Return what the camera measured itself."""
        return self._recording.telemetry

    def shows_all(self) -> bool:
        """Tell whether the first picture that can be used shows the whole sphere."""
        for frame in self._recording.frames():
            with suppress(ProjectionError):
                config = config_for(frame, self._config)
                size_wh = as_sphere(frame, config).size_wh
                return projection_of(size_wh, config).seen(MIN_WIDTH) is None
        return True

    def frames(self) -> Generator[Frame, None, None]:
        """Yield the Frames as spheres, not turned; those of another size are left out."""
        self._skip_log = SkipLog(self.name)
        for frame in self._recording.frames():
            try:
                hint = self._watch.look(frame)
                if hint:
                    logger.warning('%s: %s', self.name, hint)
                yield stitched(frame, self._config)
            except (ImageError, ProjectionError) as error:
                self._skip_log.add(error.reason, error)
