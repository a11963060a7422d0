# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Looks at pictures now and then, and says which option would read them right."""

from typing import Any

from sph_stab_ros.config import (
    DUAL_FISHEYE, EQUIRECT, FISHEYE, HALF_SPHERE, LEFT_RIGHT, StabilizerConfig, STRETCHED_EQUIRECT,
    TOP_BOTTOM, VR180)
from sph_stab_ros.images.appearance import Appearance, reduced, Seen, seen_in, SIDE_PX
from sph_stab_ros.images.frame import Frame, frame_from_message
from sph_stab_ros.images.image_error import ImageError
from sph_stab_ros.images.sphere import as_sphere, config_for

# Which pictures are looked at: the first ones, and of the others one of so many.
FIRST, SELDOM = 3, 100
# Smaller ones show nothing to go by.
MIN_SIDE_PX = 16
# How many looks in a row must say the same.
AGREEING = 3
# Circles are not found more exactly.
MAX_SQUEEZED = 0.05
READ_BY = {
    Appearance.TWO_FISHEYES: f"projection:={DUAL_FISHEYE} reads them, by the lenses' calibration "
    'in fisheye.*',
    Appearance.FISHEYE: f"projection:={FISHEYE} reads them, by the lens's calibration in "
    'fisheye.*',
    Appearance.SQUEEZED: f'projection:={STRETCHED_EQUIRECT} reads them',
    Appearance.TOP_BOTTOM: f'layout:={TOP_BOTTOM} reads them',
    Appearance.LEFT_RIGHT: f'layout:={LEFT_RIGHT} reads them',
    Appearance.VR180: f'layout:={VR180} reads them',
    Appearance.HALF_SPHERE: f'layout:={HALF_SPHERE} reads them'}


class PictureWatch:
    """
    Tells what pictures seem to be where that is not what their config says.

    ``hint`` is the line about it, '' as long as there is none.

    Parameters
    ----------
    config : StabilizerConfig
        What they are taken for; may be set to another one.

    """

    def __init__(self, config: StabilizerConfig = StabilizerConfig()) -> None:
        self.config = config
        self.hint = ''
        self._number = -1
        self._last, self._looks = '', 0
        self._said: set[str] = set()

    def look(self, picture: Frame | Any) -> str:
        """
        Return the hint if it is new, '' else.

        Of a Frame, or of an Image or CompressedImage message. Those that cannot be decoded are the
        business of others.
        """
        self._number += 1
        if self._number >= FIRST and self._number % SELDOM:
            return ''
        try:
            frame = picture if isinstance(picture, Frame) else frame_from_message(picture, 0)
            config = config_for(frame, self.config)
            frame = as_sphere(frame, config)
            if min(frame.size_wh) < MIN_SIDE_PX:
                return ''
            seen = seen_in(reduced(frame.grey(SIDE_PX)))
        except ImageError:
            return ''
        hint = hint_of(seen, config.projection) if seen else ''
        self._looks = self._looks + 1 if hint == self._last else 1
        self._last = hint
        if self._looks >= AGREEING:
            self.hint = hint
            if hint not in self._said:
                self._said.add(hint)
                return hint
        return ''


def hint_of(seen: Seen, projection: str) -> str:
    """Return which option reads pictures, or what makes spheres of them."""
    if projection != EQUIRECT:
        # Whoever has chosen another one knows more than can be seen.
        return ''
    what = f'the pictures look like {seen.appearance.value}'
    if seen.appearance not in READ_BY:
        return f'{what}, which no option reads: crop the borders away first'
    is_squeezed = (seen.appearance is Appearance.TWO_FISHEYES
                   and abs(seen.squeezed - 1) > MAX_SQUEEZED)
    return (f'{what}: -p {READ_BY[seen.appearance]}'
            + (', with -p fisheye.stretched:=true as they are squeezed' if is_squeezed else ''))
