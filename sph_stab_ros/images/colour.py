# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the values of a video's pictures mean: the code points of ITU-T H.273 and H.264, E.2.1."""

from typing import NamedTuple

# Code points of matrices, primaries and transfer characteristics.
UNSPECIFIED = 2
BT709, BT470BG, SMPTE170M, SMPTE240M, BT2020, FCC = 1, 5, 6, 7, 9, 4
# Matrices by what people call them; those of BT.601 are equal.
MATRIX_NAMES = {BT709: 'BT.709', BT470BG: 'BT.601', SMPTE170M: 'BT.601', SMPTE240M: 'SMPTE 240M',
                BT2020: 'BT.2020', FCC: 'FCC'}
# Of these sizes on, untagged pictures are taken to be of BT.709, as players do.
HD_WIDTH, HD_HEIGHT = 1280, 577


class Colour(NamedTuple):
    """
    The matrix between R'G'B' and Y'CbCr, its range, and what the primaries R, G and B mean.

    ``assumed`` says in words what no tag does.
    """

    matrix: int
    is_full_range: bool = False
    primaries: int = UNSPECIFIED
    transfer: int = UNSPECIFIED
    assumed: str = ''


# Of pictures that are no video's: sRGB's primaries, as a video usually has them.
STANDARD = Colour(BT709, False, BT709, BT709)


def colour_of(size_wh: tuple[int, int], matrix: int, is_full_range: bool | None, primaries: int,
              transfer: int) -> Colour:
    """Return the Colour of pictures (width, height) with such tags; what is missing is assumed."""
    assumed = []
    if matrix not in MATRIX_NAMES:
        untold = f' (in place of matrix {matrix} of H.273)' if matrix != UNSPECIFIED else ''
        matrix = likely_matrix(size_wh, primaries)
        assumed.append(MATRIX_NAMES[matrix] + untold)
    if is_full_range is None:
        is_full_range = False
        assumed.append('limited range')
    return Colour(matrix, is_full_range, primaries, transfer, ', '.join(assumed))


def likely_matrix(size_wh: tuple[int, int], primaries: int) -> int:
    """Return the matrix that goes with the primaries, or that of most pictures of a size."""
    if primaries in MATRIX_NAMES:
        return primaries
    width, height = size_wh
    return BT709 if width >= HD_WIDTH or height >= HD_HEIGHT else SMPTE170M
