# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Frames of one eye or of a part of the sphere as frames of a sphere."""

from dataclasses import replace
from functools import cached_property

from sph_stab_ros.config import AUTO, EQUIRECT, StabilizerConfig
from sph_stab_ros.geometry.arrays import Grey, Image, Raster
from sph_stab_ros.geometry.layout import Layout, LAYOUTS
from sph_stab_ros.images.frame import Frame


def as_sphere(frame: Frame, config: StabilizerConfig) -> Frame:
    """
    Return a Frame whose picture is an equirectangular sphere, as far as layouts are concerned.

    One eye is taken of two, and what is not seen is black; the Frame's layout tells what is.
    """
    layout = frame.layout if config.layout == AUTO else LAYOUTS.get(config.layout)
    if config.projection != EQUIRECT:
        # Where what a picture shows is the Projection's business, metadata have no say.
        return replace(frame, layout=None)
    if layout is None:
        return frame
    return replace(frame, source=SphereOf(frame, layout), layout=layout.in_sphere)


class SphereOf:
    """The sphere that a Frame holds by a Layout, made when it is asked for."""

    def __init__(self, frame: Frame, layout: Layout) -> None:
        self._frame = frame
        self._layout = layout
        self.size_wh = layout.sphere_wh(frame.size_wh)

    @cached_property
    def image(self) -> Image:
        """Return the whole sphere."""
        return self._layout.sphere(self._frame.image)

    @cached_property
    def deep_image(self) -> Raster | None:
        """Return the whole sphere as the Frame's ``deep_image``."""
        deep = self._frame.deep_image
        return None if deep is None else self._layout.sphere(deep)

    def grey(self, width: int = 0) -> Grey:
        """Return the sphere in grey; a smaller one, at least as wide as this, costs less."""
        wanted = -(-width * self._frame.size_wh[0] // self.size_wh[0])
        return self._layout.sphere(self._frame.grey(wanted))
