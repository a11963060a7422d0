# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One picture with its time, as it passes from the recordings and topics into the core."""

from dataclasses import dataclass

from sph_stab_ros.geometry.arrays import Image
from sph_stab_ros.images.times import PictureTime


@dataclass(frozen=True)
class Frame:
    """
    A picture of the sphere and when it was taken.

    ``image`` is (H, W, 3) uint8 in BGR order or (H, W) uint8 and is not written to; which of its
    pixels shows what is the Projection's business, and whether its size fits the Stabilizer's;
    ``stamp_ns`` is the header's or the container's time; ``frame_id`` names the camera's frame.
    ``times`` is what a PictureClock made of the stamp; without, the stamp is taken as it is.
    """

    image: Image
    stamp_ns: int
    frame_id: str = ''
    times: PictureTime | None = None

    @property
    def time_ns(self) -> int:
        """Return the time on the timeline of the pictures, which takes part in no clock's steps."""
        return self.stamp_ns if self.times is None else self.times.time_ns

    @property
    def clock_ns(self) -> int:
        """Return the time by the clock of the stamps, which an IMU's are of, too."""
        return self.stamp_ns if self.times is None else self.times.clock_ns

    @property
    def size_wh(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        height, width = self.image.shape[:2]
        return width, height

    def load(self) -> None:
        """Decode what is decoded only when it is asked for."""

    def at_least(self, width: int) -> Image:
        """Return the image, or a smaller one of it, grey perhaps, that is as wide as this."""
        return self.image
