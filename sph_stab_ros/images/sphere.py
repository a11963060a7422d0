# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Frames as a recording's metadata and a config say that they show the sphere."""

from dataclasses import replace
from functools import cached_property, lru_cache

from scipy.spatial.transform import Rotation

from sph_stab_ros.config import AUTO, EQUIRECT, StabilizerConfig
from sph_stab_ros.geometry.arrays import Grey, Image, Raster
from sph_stab_ros.geometry.layout import Layout, LAYOUTS
from sph_stab_ros.geometry.projection import Equirect
from sph_stab_ros.geometry.projection_factory import projection_of
from sph_stab_ros.geometry.warp import equirect_warp
from sph_stab_ros.images.frame import Frame


def config_for(frame: Frame, config: StabilizerConfig) -> StabilizerConfig:
    """
    Return the config by which a Frame is read.

    Metadata have their say where the config leaves it to them; the Frame's refusal is raised then.
    """
    if config.projection != EQUIRECT or config.layout != AUTO:
        return config
    if frame.refusal is not None:
        raise frame.refusal
    projection = EQUIRECT if frame.layout is None else frame.layout.projection
    return config if projection == EQUIRECT else _with_projection(config, projection)


@lru_cache(maxsize=1)
def _with_projection(config: StabilizerConfig, projection: str) -> StabilizerConfig:
    return replace(config, projection=projection)


def as_sphere(frame: Frame, config: StabilizerConfig) -> Frame:
    """
    Return a Frame whose picture is an equirectangular sphere, as far as layouts are concerned.

    One eye is taken of two, and what is not seen is black; the Frame's layout tells what is. The
    config is that of ``config_for``.
    """
    layout = frame.layout if config.layout == AUTO else LAYOUTS.get(config.layout)
    if layout is None or config.projection != EQUIRECT:
        # Where what a picture shows is the Projection's business, metadata have no say.
        return replace(frame, layout=None)
    return replace(frame, source=SphereOf(frame, layout), layout=layout.in_sphere)


def stitched(frame: Frame, config: StabilizerConfig) -> Frame:
    """Return the Frame as an equirectangular sphere, not turned, or raise ProjectionError."""
    config = config_for(frame, config)
    frame = as_sphere(frame, config)
    projection = projection_of(frame.size_wh, config)
    if isinstance(projection, Equirect):
        return frame
    warp = equirect_warp(projection.sphere_width)
    return replace(frame, source=warp(frame.image, Rotation.identity(), projection))


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
