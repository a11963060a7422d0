# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Procedural pictures for the surfaces of a simulated room.

Every function returns a float32 BGR image (h, w, 3) within 0…255, `w, h` being the surface's
size in texels, row 0 at the top. `scale` is texels per metre.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from sph_stab_ros.geometry.arrays import Floats, Plane

# (h, w, 3), blue first, within 0…255.
Texture: TypeAlias = Floats
# Paints a surface (rng, w, h, scale).
Paint: TypeAlias = Callable[[Generator, int, int, float], Texture]


def smooth_noise(rng: Generator, w: int, h: int, cell: float) -> Plane:
    """Noise (h, w) of unit variance whose features are about `cell` texels large."""
    coarse = rng.standard_normal((max(2, round(h / cell) + 1), max(2, round(w / cell) + 1)))
    return cv2.resize(coarse.astype(np.float32), (w, h), interpolation=cv2.INTER_CUBIC)


def plaster(rng: Generator, w: int, h: int, scale: float, colour: ArrayLike) -> Texture:
    """Painted plaster: a plain colour with faint stains and roller marks."""
    faint = 2 * smooth_noise(rng, w, h, 0.6 * scale) + 2 * smooth_noise(rng, w, h, 0.06 * scale)
    return np.full((h, w, 3), colour, np.float32) + faint[..., None]


def wall(rng: Generator, w: int, h: int, scale: float, plain: bool) -> Texture:
    """Plaster with skirting; if not `plain`, with posters, windows and a door as space permits."""
    image = plaster(rng, w, h, scale, rng.uniform((190, 195, 200), (215, 225, 230)))
    skirting = round(0.09 * scale)
    image[h - skirting:] *= 0.45
    if plain:
        _paste(image, socket(scale), rng.uniform(0.1, 0.9) * w, h - 0.35 * scale)
        return image
    x = rng.uniform(0.2, 0.6) * scale
    decorations: Any = [door, window, poster, poster, poster, window, poster]
    for decoration in rng.permutation(decorations):
        picture = decoration(rng, scale)
        ph, pw = picture.shape[:2]
        if x + pw > w - 0.1 * scale:
            break
        on_floor = decoration is door
        bottom = h if on_floor else h - rng.uniform(0.75, 1.05) * scale
        _paste(image, picture, x + pw / 2, bottom - ph / 2)
        x += pw + rng.uniform(0.25, 0.9) * scale
    return image


def socket(scale: float) -> Texture:
    """Return a wall socket."""
    size = round(0.16 * scale)
    image = np.full((size, size, 3), 235, np.float32)
    cv2.rectangle(image, (0, 0), (size - 1, size - 1), (150, 150, 150), 1)
    cv2.circle(image, (size // 2, size // 2), size // 3, (90, 90, 90), -1, cv2.LINE_AA)
    return image


def door(rng: Generator, scale: float) -> Texture:
    """Return a panelled wooden door in its frame."""
    w, h = round(0.95 * scale), round(2.05 * scale)
    image = wood(rng, w, h, scale, rng.uniform((40, 60, 90), (90, 120, 150)))
    frame = round(0.06 * scale)
    image[:frame] = image[:, :frame] = image[:, -frame:] = 225
    for top, bottom in ((0.1, 0.45), (0.52, 0.93)):
        for left, right in ((0.14, 0.46), (0.54, 0.86)):
            a = (round(left * w), round(top * h))
            b = (round(right * w), round(bottom * h))
            cv2.rectangle(image, a, b, (30, 40, 50), max(1, round(0.015 * scale)), cv2.LINE_AA)
    cv2.circle(image, (round(0.88 * w), round(0.5 * h)), round(0.03 * scale), (200, 210, 215), -1,
               cv2.LINE_AA)
    return image


def window(rng: Generator, scale: float) -> Texture:
    """Return a window on a bright sky and trees."""
    w, h = round(rng.uniform(1.0, 1.5) * scale), round(1.2 * scale)
    height = np.linspace(0, 1, h, dtype=np.float32)[:, None, None]
    image = (1 - height) * (250, 235, 215) + height * (250, 248, 245)
    image = np.broadcast_to(image, (h, w, 3)).astype(np.float32)
    skyline = 0.55 + 0.08 * smooth_noise(rng, w, 1, 0.1 * scale)[0]
    trees = height[:, :, 0] > skyline[None]
    leaves = 1 + 0.3 * smooth_noise(rng, w, h, 0.03 * scale)[..., None]
    image = np.where(trees[..., None], np.array((80, 130, 100), np.float32) * leaves, image)
    bar = max(2, round(0.05 * scale))
    for x in (0, w // 2 - bar // 2, w - bar):
        image[:, x:x + bar] = 240
    image[:bar] = image[-bar:] = 240
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), (120, 120, 120), max(1, bar // 4))
    return image


def poster(rng: Generator, scale: float) -> Texture:
    """Return a poster with shapes and lines of print."""
    w, h = round(rng.uniform(0.5, 1.1) * scale), round(rng.uniform(0.6, 1.1) * scale)
    image = np.full((h, w, 3), rng.uniform(120, 250, 3), np.float32)
    image += 18 * smooth_noise(rng, w, h, 0.2 * scale)[..., None]
    for _ in range(7):
        centre = (int(rng.uniform(0, w)), int(rng.uniform(0, 0.7 * h)))
        colour = tuple(float(c) for c in rng.uniform(10, 245, 3))
        if rng.random() < 0.5:
            cv2.circle(image, centre, int(rng.uniform(0.03, 0.15) * scale), colour, -1,
                       cv2.LINE_AA)
        else:
            other = (int(rng.uniform(0, w)), int(rng.uniform(0, 0.7 * h)))
            cv2.line(image, centre, other, colour, max(1, int(rng.uniform(0.01, 0.05) * scale)),
                     cv2.LINE_AA)
    line = max(2, round(0.035 * scale))
    for y in range(round(0.74 * h), round(0.94 * h) - line, 2 * line):
        end = round(rng.uniform(0.5, 0.92) * w)
        image[y:y + line, round(0.08 * w):end] = rng.uniform(20, 80)
    border = max(1, round(0.015 * scale))
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), 3 * (rng.uniform(20, 240),), border)
    return image


def tiles(rng: Generator, w: int, h: int, scale: float) -> Texture:
    """Floor of 0.4 m tiles of slightly different shades, with joints and speckles."""
    size = 0.4 * scale
    columns, rows = (np.arange(n) / size for n in (w, h))
    shades = rng.normal(1.0, 0.05, (int(rows[-1]) + 1, int(columns[-1]) + 1))
    shade = shades[rows.astype(int)[:, None], columns.astype(int)[None]]
    shade = shade + 0.03 * smooth_noise(rng, w, h, 0.15 * scale)
    shade += 0.09 * smooth_noise(rng, w, h, 0.025 * scale)
    joint = 0.012 * scale / size
    in_joint = ((columns % 1) < joint)[None] | ((rows % 1) < joint)[:, None]
    shade = np.where(in_joint, 0.6, shade)
    return (shade[..., None] * rng.uniform((110, 125, 140), (150, 160, 170))).astype(np.float32)


def ceiling(rng: Generator, w: int, h: int, scale: float, plain: bool) -> Texture:
    """White ceiling with lamps and a smoke detector; if not `plain`, of 0.6 m mineral panels."""
    image = plaster(rng, w, h, scale, np.array((205, 208, 210)))
    if not plain:
        image += 7 * smooth_noise(rng, w, h, 0.03 * scale)[..., None]
        bar = max(1, round(0.024 * scale))
        for edge in np.arange(0, max(w, h), 0.6 * scale).astype(int):
            image[edge:edge + bar] = image[:, edge:edge + bar] = (165, 168, 170)
    lamp = np.full((round(0.3 * scale), round(1.2 * scale), 3), (238, 252, 255), np.float32)
    for fx in (0.25, 0.75):
        for fy in (0.3, 0.7):
            _paste(image, lamp, fx * w, fy * h)
    cv2.circle(image, (round(0.45 * w), round(0.55 * h)), round(0.06 * scale), (150, 150, 150), -1,
               cv2.LINE_AA)
    return image


def wood(rng: Generator, w: int, h: int, scale: float, colour: ArrayLike) -> Texture:
    """Wood with vertical grain."""
    streaks = cv2.resize(smooth_noise(rng, w, max(2, h // 12), 0.02 * scale), (w, h))
    return (np.asarray(colour, np.float32)
            * (1 + 0.08 * streaks + 0.05 * smooth_noise(rng, w, h, 0.3 * scale))[..., None])


def cupboard(rng: Generator, w: int, h: int, scale: float) -> Texture:
    """Front of a cupboard: wooden doors with gaps and handles, or shelves with books."""
    # What all sides share is drawn before anything whose size differs between them.
    has_doors, colour = rng.random() < 0.5, rng.uniform((50, 80, 110), (170, 190, 205))
    image = wood(rng, w, h, scale, colour)
    gap = max(1, round(0.012 * scale))
    if has_doors:
        for x in np.arange(0, w, max(0.45 * scale, 1)).astype(int):
            image[:, x:x + gap] *= 0.4
            cv2.circle(image, (int(x + 0.06 * scale), h // 2), max(1, round(0.02 * scale)),
                       (210, 210, 210), -1, cv2.LINE_AA)
        return image
    shelf = max(4, round(0.34 * scale))
    for y in range(gap, h - shelf // 2, shelf):
        image[y:y + shelf - 2 * gap, 2 * gap:w - 2 * gap] = 35
        x = 2 * gap
        while x < w - 3 * gap:
            thick = max(2, round(rng.uniform(0.02, 0.07) * scale))
            top = y + round(rng.uniform(0.1, 0.45) * shelf)
            if rng.random() < 0.85:
                image[top:y + shelf - 2 * gap, x:min(x + thick, w - 2 * gap)] = (
                    rng.uniform(20, 220, 3))
            x += thick + 1
    return image


def crate(rng: Generator, w: int, h: int, scale: float) -> Texture:
    """Cardboard with tape and a label."""
    image = wood(rng, w, h, scale, np.array((95, 140, 180)))
    tape = max(2, round(0.05 * scale))
    image[:, w // 2 - tape // 2:w // 2 + tape // 2] *= 1.2
    label = poster(rng, 0.2 * scale)
    _paste(image, label, 0.25 * w, 0.6 * h)
    return image


def pillar(rng: Generator, w: int, h: int, scale: float) -> Texture:
    """Plaster, as the walls."""
    return plaster(rng, w, h, scale, np.array((200, 205, 208)))


def clothing(rng: Generator, w: int, h: int, scale: float) -> Texture:
    """Trousers and a striped shirt, from feet to shoulders."""
    trousers, shirt = rng.uniform(30, 110, 3), rng.uniform(40, 230, 3)
    stripe = max(2, round(rng.uniform(0.03, 0.08) * scale))
    waist = round(0.42 * h)
    image = np.full((h, w, 3), trousers, np.float32)
    image[:waist] = shirt
    for y in range(0, waist - stripe, 3 * stripe):
        image[y:y + stripe] *= 0.7
    return image * (1 + 0.12 * smooth_noise(rng, w, h, 0.08 * scale)[..., None])


def outdoor_clothing(rng: Generator, w: int, h: int, scale: float) -> Texture:
    """Washed trousers below a gaudy jacket, with patches, pockets and prints all over."""
    image = np.empty((h, w, 3), np.float32)
    waist = round(0.45 * h)
    image[:waist], image[waist:] = rng.uniform(70, 200, 3), rng.uniform(50, 130, 3)
    patches = rng.uniform((0, 0, 0.02, 0.02, 0, 0, 0), (0.42, 1, 0.12, 0.15, 255, 255, 255),
                          (25, 7))
    for x_m, y, patch_w_m, patch_h_m, *colour in patches:
        left, top = round(x_m * scale), round(y * h)
        image[top:top + round(patch_h_m * scale), left:left + round(patch_w_m * scale)] = colour
    for cell_m, strength in ((0.2, 0.15), (0.05, 0.15), (0.02, 0.12)):
        image *= 1 + strength * smooth_noise(rng, w, h, cell_m * scale)[..., None]
    return image


def skin(rng: Generator, w: int, h: int, scale: float) -> Texture:
    """Return a head: skin below hair."""
    image = np.full((h, w, 3), (120, 150, 195), np.float32)
    image[:round(0.35 * h)] = rng.uniform(20, 80, 3)
    return image * (1 + 0.05 * smooth_noise(rng, w, h, 0.04 * scale))[..., None]


def machine(rng: Generator, w: int, h: int, scale: float) -> Texture:
    """Sheet metal of a robot with slots, screws and a label."""
    image = np.full((h, w, 3), rng.choice(((35, 35, 130), (45, 45, 45))), np.float32)
    image += 4 * smooth_noise(rng, w, h, 0.03 * scale)[..., None]
    for _ in range(10):
        x, y = int(rng.uniform(0, w)), int(rng.uniform(0, h))
        size = max(1, int(rng.uniform(0.01, 0.06) * scale))
        image[y:y + size, x:x + 2 * size] = rng.uniform(10, 170) + rng.uniform(-8, 8, 3)
    return image


def _paste(image: Texture, picture: Texture, x: float, y: float) -> None:
    """Put a picture into the image, centred at x, y, cut off at the borders."""
    h, w = picture.shape[:2]
    left, top = round(x - w / 2), round(y - h / 2)
    x0, y0 = max(left, 0), max(top, 0)
    part = picture[y0 - top:image.shape[0] - top, x0 - left:image.shape[1] - left]
    image[y0:y0 + part.shape[0], x0:x0 + part.shape[1]] = part
