# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Patches of texture on the sphere, and where they are in another picture.

A patch is read on a plane that touches the sphere, so that neither latitude nor the camera's turn
changes it; and it is found again straight in the camera's picture, where no second warp blurs.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from sph_stab_ros import kernels
from sph_stab_ros.geometry.arrays import Bearings, Floats, Grey, Indices, Values, Vectors
from sph_stab_ros.geometry.equirect import pad_sphere
from sph_stab_ros.tracking.anchored.table import Table

# The whole picture, and half of it.
LEVELS = 2
# A patch has 11×11 samples; the compiled loops know it too.
SAMPLES = 11


@dataclass(frozen=True)
class PatchOptions:
    """How patches are cut and found; pixels are those of a level, pairs one value per level."""

    # Standard deviation of a picture's blur, so that gradients by differences hold between pixels.
    blur_px: float = 0.5
    # From sample to sample: a patch is 15 px wide, 8° of a picture of 640 columns.
    spacing_px: float = 1.5
    # Pictures go on so far beyond their edges, small ones less: half a patch at 68° of latitude,
    # and what it moves.
    margin_px: int = 48
    # Nearer to the poles patches are not read exactly, see _maps.
    max_latitude_rad: float = np.deg2rad(68)
    # At most so many; most patches have settled before.
    iterations: tuple[int, int] = (4, 3)
    # No step is longer: gradients do not hold farther than the texture is wide.
    max_step_px: float = 2.0
    # So short a step is the last one: a patch is hardly exacter, or the next level mends it.
    settled_px: tuple[float, float] = (0.1, 0.3)
    # What is seen with less contrast, in grey values, is not amplified any more: it is noise.
    min_contrast: float = 1.0
    # Standard deviation of a strong corner (0.08 is what remains in clips that are only turned),
    # and the mean squared gradient per pixel that makes one half as certain.
    corner_sigma_px: float = 0.1
    noise_gradient: float = 50.0


class Pyramid:
    """
    A grey sphere (H, W) uint8, blurred and continued beyond its edges, whole and halved.

    Each is made when it is asked for: the halved one seldom is.
    """

    def __init__(self, grey: Grey, options: PatchOptions) -> None:
        self.options = options
        self.width = grey.shape[1]
        self.margin_px = min(options.margin_px, grey.shape[0] >> LEVELS - 1)
        self._grey = grey
        self._images: dict[int, Grey] = {}

    def image(self, level: int) -> Grey:
        """Return the picture of a level with its margins."""
        if level not in self._images:
            grey = self._grey if level == 0 else cv2.resize(
                self._grey, None, fx=0.5 ** level, fy=0.5 ** level, interpolation=cv2.INTER_AREA)
            # Farther away a byte has no weight; OpenCV would count it in, for half as much again.
            side_px = 2 * int(3.5 * self.options.blur_px) + 1
            self._images[level] = cv2.GaussianBlur(
                pad_sphere(grey, self.margin_px), (side_px, side_px), self.options.blur_px)
        return self._images[level]

    def px_per_rad(self, level: int = 0) -> float:
        """Return the number of pixels of a level per radian."""
        return (self.width >> level) / (2 * np.pi)

    def read(self, level: int, u: Floats, v: Floats) -> Floats:
        """Return the grey values (N, P) float32 at pixels u, v (N, P) of a level."""
        if kernels.library is not None:
            image, grey = self.image(level), np.empty(u.shape, np.float32)
            kernels.library.read_pixels(u.size, image, *image.shape, u, v, grey)
            return grey
        # OpenCV refuses to read nothing.
        return np.asarray(cv2.remap(self.image(level), u, v, cv2.INTER_LINEAR)
                          if len(u) else u, np.float32)


@dataclass
class Patches(Table):
    """
    N patches of P samples each.

    ``templates`` (N, L, P) are their grey values less the mean, ``deviations`` (N, L) the standard
    deviations of these, ``solvers`` (N, L, 2, P) what turns a difference of grey values into an
    offset in pixels (``(GᵀG)⁻¹Gᵀ``, free of brightness and contrast), ``sqrt_information_px``
    (N, 2, 2) tells how exactly a patch can be found, per pixel.
    """

    templates: Floats
    deviations: Floats
    solvers: Floats
    sqrt_information_px: Floats

    @classmethod
    def cut(cls, pyramid: Pyramid, x: Bearings, east: Vectors, south: Vectors) -> 'Patches':
        """Return the Patches around bearings x (N, 3) with unit tangents east and south there."""
        levels, options = [], pyramid.options
        for level in range(LEVELS):
            u, v, _, _ = _maps(x, east, south, pyramid, level, SAMPLES + 2, np.ones(len(x)))
            grey = pyramid.read(level, u, v).reshape(len(x), SAMPLES + 2, SAMPLES + 2)
            inner = grey[:, 1:-1, 1:-1].reshape(len(x), -1)
            G = np.stack(((grey[:, 1:-1, 2:] - grey[:, 1:-1, :-2]).reshape(len(x), -1),
                          (grey[:, 2:, 1:-1] - grey[:, :-2, 1:-1]).reshape(len(x), -1)), axis=1)
            G /= 2 * options.spacing_px
            if level == 0:
                sqrt_information_px = _sqrt_information_px(
                    np.einsum('nip,njp->nij', G, G) / inner.shape[1], options)
            template = inner - inner.mean(axis=1, keepdims=True)
            squared = np.maximum(np.einsum('np,np->n', template, template), 1e-6)
            # What a change of brightness or contrast would look like says nothing of an offset.
            G -= G.mean(axis=2, keepdims=True)
            G -= (np.einsum('nip,np->ni', G, template) / squared[:, None])[..., None] \
                * template[:, None]
            H = np.einsum('nip,njp->nij', G, G)
            H += (1e-3 * np.trace(H, axis1=1, axis2=2) + 1e-3)[:, None, None] * np.eye(2)
            levels.append((template, np.sqrt(squared / inner.shape[1]),
                           np.float32(np.linalg.solve(H, G))))
        templates, deviations, solvers = (np.stack(one, axis=1) for one in zip(*levels))
        return cls(templates, deviations, solvers, sqrt_information_px)

    def find(self, rows: Indices, pyramid: Pyramid, expected: Bearings, east: Vectors,
             south: Vectors, scale: Values,
             levels: int = LEVELS) -> tuple[Floats, Values, Values]:
        """
        Return where the patches in rows are in a picture.

        Inverse compositional alignment (S. Baker and I. Matthews, *Lucas–Kanade 20 years on: a
        unifying framework*, International Journal of Computer Vision 56(3), 2004), free of
        brightness and contrast, which the solvers do not see (G. Hager and P. Belhumeur,
        *Efficient region tracking with parametric models of geometry and illumination*, IEEE
        Transactions on Pattern Analysis and Machine Intelligence 20(10), 1998).

        Parameters
        ----------
        rows : (N,) int
            Which patches to look for.
        pyramid : Pyramid
            Of the picture.
        expected, east, south : (N, 3)
            Where to look first, in the camera, and the patches' tangents there.
        scale : (N,)
            How many times as large the patches have become.
        levels : int
            Of the pyramid to use; with one they must be within 2 px.

        Returns
        -------
        offsets : (N, 2)
            In radians along east and south.
        correlation : (N,)
            Of the grey values, 1 where they are the same.
        last_step_px : (N,)
            Of the iteration; large where it did not settle.

        """
        offsets = np.zeros((len(rows), 2))
        settle = self._settle if kernels.library is None else self._settle_compiled
        for level in reversed(range(levels)):
            difference, length = settle(
                rows, pyramid, level, expected, east, south, scale, offsets)
        deviation = np.maximum(self.deviations[rows, level], pyramid.options.min_contrast)
        return offsets, 1 - difference / (2 * deviation ** 2), length

    def _settle_compiled(self, rows: Indices, pyramid: Pyramid, level: int, expected: Bearings,
                         east: Vectors, south: Vectors, scale: Values,
                         offsets: Floats) -> tuple[Values, Values]:
        difference, length = np.zeros((2, len(rows)), np.float32)
        image, options = pyramid.image(level), pyramid.options
        kernels.library.settle_patches(
            len(rows), rows, expected, east, south, scale, image, *image.shape,
            pyramid.margin_px, self.templates, self.deviations, self.solvers, level, LEVELS,
            options.spacing_px, options.iterations[level], options.max_step_px,
            options.settled_px[level], options.min_contrast, offsets, difference, length)
        return difference, length

    def _settle(self, rows: Indices, pyramid: Pyramid, level: int, expected: Bearings,
                east: Vectors, south: Vectors, scale: Values,
                offsets: Floats) -> tuple[Values, Values]:
        """Improve offsets (N, 2) in place; return mean squared differences, last steps (N,)."""
        px, options = pyramid.px_per_rad(level), pyramid.options
        b = expected + offsets[:, :1] * east + offsets[:, 1:] * south
        b /= np.linalg.norm(b, axis=1, keepdims=True)
        u, v, u_moves, v_moves = _maps(b, east, south, pyramid, level, SAMPLES, scale)
        template, deviation = self.templates[rows, level], self.deviations[rows, level]
        solver = self.solvers[rows, level] * np.asarray(scale, np.float32)[:, None, None]
        for _ in range(options.iterations[level]):
            grey = pyramid.read(level, u, v)
            grey -= grey.mean(axis=1, keepdims=True)
            seen = np.sqrt(np.einsum('np,np->n', grey, grey) / grey.shape[1])
            grey *= (deviation / np.maximum(seen, options.min_contrast))[:, None]
            grey -= template
            step = np.einsum('nip,np->ni', solver, grey)
            length = np.sqrt(np.einsum('ni,ni->n', step, step))
            step *= np.minimum(1, options.max_step_px / np.maximum(length, 1e-6))[:, None]
            offsets -= step / px
            u -= np.einsum('ni,ni->n', u_moves, step)[:, None]
            v -= np.einsum('ni,ni->n', v_moves, step)[:, None]
        return np.einsum('np,np->n', grey, grey) / grey.shape[1], length


def _sqrt_information_px(G: Floats, options: PatchOptions) -> Floats:
    """
    Return the symmetric root of ``G (G + G0)⁻¹ / σ²`` for mean structure tensors (N, 2, 2).

    That G is the information about an offset is W. Förstner and E. Gülch's, *A fast operator for
    detection and precise location of distinct points, corners and centres of circular features*,
    ISPRS Intercommission Workshop, 1987; that it ends at σ is ours: noise is not the worst error.
    """
    values, vectors = np.linalg.eigh(G)
    values = np.maximum(values, 1e-3)
    roots = np.sqrt(values / (values + options.noise_gradient)) / options.corner_sigma_px
    return (vectors * roots[:, None, :]) @ np.swapaxes(vectors, 1, 2)


def _maps(b: Bearings, east: Vectors, south: Vectors, pyramid: Pyramid, level: int, samples: int,
          scale: Values) -> tuple[Floats, Floats, Floats, Floats]:
    """
    Return the pixels u, v (N, P) of patches, and how they move per pixel of offset, (N, 2) each.

    Longitude and latitude are expanded to second order around the patches' centres, in a tenth of
    the time: at the corners within 0.1 px of exact up to 50° of latitude, 0.7 px at 68°, to
    opposite sides, so that offsets do not suffer.
    """
    coordinates = np.arange(samples, dtype=np.float32) - np.float32((samples - 1) / 2)
    down, right = (one.ravel() for one in np.meshgrid(coordinates, coordinates, indexing='ij'))
    powers = np.stack((np.ones_like(right), right, down, right ** 2, right * down, down ** 2))
    px = pyramid.px_per_rad(level)
    spacing_rad = scale * pyramid.options.spacing_px / px
    steps = px * spacing_rad[:, None] ** (0, 1, 1, 2, 2, 2)
    lon, lat = _expansion(b, east, south)
    width = pyramid.width >> level
    u = np.float32(lon * steps) @ powers + np.float32(width / 2 - 0.5 + pyramid.margin_px)
    v = np.float32(lat * steps) @ powers + np.float32(width / 4 - 0.5 + pyramid.margin_px)
    return u, v, lon[:, 1:3].astype(np.float32), lat[:, 1:3].astype(np.float32)


def _expansion(b: Bearings, east: Vectors, south: Vectors) -> tuple[Floats, Floats]:
    """
    Return longitude and latitude (downwards) around unit bearings b (N, 3) to second order.

    Coefficients (N, 6) each, of 1, e, s, e², es and s² along tangents east and south.
    """
    x, y, z = b.T
    rho = np.maximum(np.hypot(x, z), 1e-2)
    lon, lat = np.empty((2, len(b), 6))
    lon[:, 0], lat[:, 0] = np.arctan2(x, z), np.arctan2(y, rho)
    tangents = east, south
    # Derivatives of rho, and rho² times those of longitude.
    out = [(x * t[:, 0] + z * t[:, 2]) / rho for t in tangents]
    around = [z * t[:, 0] - x * t[:, 2] for t in tangents]
    for i, t in enumerate(tangents):
        lon[:, 1 + i] = around[i] / rho ** 2
        lat[:, 1 + i] = rho * t[:, 1] - y * out[i]
    for column, (i, j), share in ((3, (0, 0), 0.5), (4, (0, 1), 1.), (5, (1, 1), 0.5)):
        a, c = tangents[i], tangents[j]
        lon[:, column] = share * ((c[:, 2] * a[:, 0] - c[:, 0] * a[:, 2]) / rho ** 2
                                  - 2 * around[i] * out[j] / rho ** 3)
        bend = (a[:, 0] * c[:, 0] + a[:, 2] * c[:, 2] - out[i] * out[j]) / rho
        lat[:, column] = share * (out[j] * a[:, 1] - c[:, 1] * out[i] - y * bend)
    return lon, lat
