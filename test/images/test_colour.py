# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Colours between Y'CbCr and B'G'R': ITU-R BT.601, BT.709 and BT.2020 as they state themselves."""

import cv2
import numpy as np
import pytest
from sph_stab_ros.images.colour import (
    BT2020, BT470BG, BT709, Colour, colour_of, DEEP_BITS, from_bgr, grey_from_luma, MATRICES,
    SMPTE170M, SMPTE240M, to_bgr, UNSPECIFIED)

# Of limited range with eight bits, as test patterns print them.
PRINTED = {
    SMPTE170M: {'red': (81, 90, 240), 'green': (145, 54, 34), 'blue': (41, 240, 110)},
    BT709: {'red': (63, 102, 240), 'green': (173, 42, 26), 'blue': (32, 240, 118)},
    BT2020: {'red': (74, 97, 240), 'green': (164, 47, 25), 'blue': (29, 240, 119)}}
BGR = {'red': (0, 0, 255), 'green': (0, 255, 0), 'blue': (255, 0, 0)}
COLOURS = [Colour(matrix, is_full) for matrix in MATRICES for is_full in (False, True)]


def picture(bgr):
    """Return a small picture of one colour."""
    return np.full((4, 6, 3), bgr, np.uint8)


def exact_yuv(bgr, colour, bits=8):
    """Return Y'CbCr (..., 3) of B'G'R' (..., 3), by the equations of the recommendations."""
    b, g, r = np.moveaxis(bgr / 255., -1, 0)
    _, red, blue = MATRICES[colour.matrix]
    y = red * r + (1 - red - blue) * g + blue * b
    cb, cr = (b - y) / (2 * (1 - blue)), (r - y) / (2 * (1 - red))
    if colour.is_full_range:
        return np.stack((y, cb, cr), -1) * (2 ** bits - 1) + (0, 2 ** (bits - 1), 2 ** (bits - 1))
    return np.stack((219 * y + 16, 224 * cb + 128, 224 * cr + 128), -1) * 2 ** (bits - 8)


@pytest.mark.parametrize('matrix', PRINTED)
def test_pure_colours_have_the_values_that_are_printed(matrix):
    """To one level: OpenCV's coefficients are of ten bits."""
    for name, yuv in PRINTED[matrix].items():
        found = [int(plane[0, 0]) for plane in from_bgr(picture(BGR[name]), Colour(matrix))]
        assert np.abs(np.subtract(found, yuv)).max() <= 1


@pytest.mark.parametrize('colour', COLOURS, ids=str)
def test_black_grey_and_white_have_no_chroma(colour):
    for level in (0, 77, 255):
        y, cb, cr = (plane[0, 0] for plane in from_bgr(picture(level), colour))
        assert (cb, cr) == (128, 128)
        assert y == np.rint(level if colour.is_full_range else 16 + 219 * level / 255)
        assert grey_from_luma(colour.is_full_range)[y] == pytest.approx(level, abs=1)


@pytest.mark.parametrize('colour', COLOURS, ids=str)
@pytest.mark.parametrize('bits', [8, 10, 12])
def test_colours_come_out_as_they_went_in(colour, bits):
    """Within what eight bits leave; of more bits, within rounding."""
    bgr = np.random.default_rng(0).integers(0, 256, (40, 60, 3)).astype(np.uint8)
    yuv = np.clip(np.rint(exact_yuv(bgr, colour, bits)), 0, 2 ** bits - 1)
    planes = np.moveaxis(yuv.astype(np.uint8 if bits == 8 else np.uint16), -1, 0)
    found = to_bgr(planes, (60, 40), colour, bits)
    assert found.dtype == np.uint8
    assert np.abs(found.astype(int) - bgr).max() <= (2 if bits == 8 else 1)


@pytest.mark.parametrize('colour', COLOURS, ids=str)
@pytest.mark.parametrize('bits, bgr_bits', [(8, 8), (10, DEEP_BITS)])
def test_values_come_out_as_they_went_in(colour, bits, bgr_bits):
    """What has been decoded is encoded with the same values; a picture of colours that exist."""
    bgr = np.random.default_rng(0).integers(0, 256, (20, 30, 3)).astype(np.uint8)
    # The purest ones of full range have a chroma of one level more than there is.
    bgr[0, :6] = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [255, 0, 255], [255] * 3]
    planes = [np.clip(np.rint(plane), 0, 2 ** bits - 1).astype(
        np.uint8 if bits == 8 else np.uint16)
        for plane in np.moveaxis(exact_yuv(bgr, colour, bits), -1, 0)]
    large = [cv2.resize(plane, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
             for plane in planes]
    y, cb, cr = from_bgr(to_bgr(large, (60, 40), colour, bits, bgr_bits), colour)
    for found, expected in zip((y, cb, cr), (large[0], *planes[1:])):
        assert np.abs(found.astype(int) - expected).max() <= 1


def test_colours_that_no_screen_has_are_cut_off():
    """Not wrapped around."""
    for bits, kind in ((8, np.uint8), (10, np.uint16)):
        finer = 2 ** (bits - 8)
        for y, cb, cr, expected in ((0, 128, 128, (0, 0, 0)), (255, 128, 128, (255, 255, 255)),
                                    (235, 240, 128, (255, 231, 255)), (16, 16, 128, (0, 24, 0))):
            planes = [np.full((2, 2), finer * value, kind) for value in (y, cb, cr)]
            found = to_bgr(planes, (2, 2), Colour(BT709), bits)[0, 0].astype(int)
            assert np.abs(found - expected).max() <= 1


@pytest.mark.parametrize('size_wh, primaries, matrix', [
    ((1920, 960), UNSPECIFIED, BT709), ((1280, 640), UNSPECIFIED, BT709),
    ((1024, 577), UNSPECIFIED, BT709), ((1278, 576), UNSPECIFIED, SMPTE170M),
    ((640, 320), UNSPECIFIED, SMPTE170M), ((640, 320), BT709, BT709),
    ((640, 320), BT2020, BT2020), ((3840, 1920), BT470BG, BT470BG),
    ((3840, 1920), SMPTE240M, SMPTE240M), ((1920, 960), 12, BT709)])
def test_what_is_not_tagged_is_assumed_and_named(size_wh, primaries, matrix):
    """By the primaries, else by the size as players do."""
    colour = colour_of(size_wh, UNSPECIFIED, None, primaries, 14)
    assert colour[:4] == (matrix, False, primaries, 14)
    assert colour.assumed == f'{MATRICES[matrix][0]}, limited range'
    half = colour_of(size_wh, UNSPECIFIED, True, primaries, 14)
    assert half.is_full_range and half.assumed == MATRICES[matrix][0]


@pytest.mark.parametrize('matrix', MATRICES)
def test_nothing_is_assumed_of_what_is_tagged(matrix):
    assert colour_of((640, 320), matrix, True, 9, 16) == (matrix, True, 9, 16, '')


def test_a_matrix_that_is_not_read_is_named():
    """Y, Cg and Co, for example."""
    assert '8 of H.273' in colour_of((640, 320), 8, False, 1, 1).assumed
