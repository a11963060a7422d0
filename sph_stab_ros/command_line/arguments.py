# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""What the texts of arguments mean, of kinds that several commands may take."""

from argparse import ArgumentTypeError
from collections.abc import Callable, Collection
import math
from pathlib import Path
import sys


# Thirty years: libraries count finer units in 64 bits.
MOST_SECONDS = 1e9


def names_argument(known: Collection[str]) -> Callable[[str], list[str]]:
    """Return a converter of a comma-separated list of names, each in ``known``."""
    def convert(text: str) -> list[str]:
        names = list(dict.fromkeys(text.split(',')))
        for name in names:
            if name not in known:
                raise ArgumentTypeError(f"'{name}' is none of {', '.join(known)}")
        return names
    return convert


def whole_number(least: int, most: float = math.inf) -> Callable[[str], int]:
    """Return a converter of a whole number within bounds."""
    bounds = f'at least {least}' if most == math.inf else f'within {least} and {most}'

    def convert(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            raise ArgumentTypeError(f"'{text}' is not a whole number") from None
        if number > sys.maxsize:
            raise ArgumentTypeError(f'must be at most {sys.maxsize}')
        if not least <= number <= most:
            raise ArgumentTypeError(f'must be {bounds}')
        return number
    return convert


def seconds_argument(text: str) -> float:
    """Return a number of seconds, 0 or more."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    # Written so that NaN fails.
    if not 0 <= seconds <= MOST_SECONDS:
        raise ArgumentTypeError(f'must be a number of seconds, 0 to {MOST_SECONDS:g}')
    return seconds


def period_argument(text: str) -> float:
    """Return a number of seconds above 0."""
    seconds = seconds_argument(text)
    if not seconds:
        raise ArgumentTypeError('must be a number of seconds above 0')
    return seconds


def file_argument(text: str) -> Path:
    """Return the path of a file to write, whose folder must exist."""
    if Path(text).is_dir():
        raise ArgumentTypeError(f"'{text}' is a folder")
    return output_argument(text)


def output_argument(text: str) -> Path:
    """Return the path of an output, whose folder must exist."""
    path = Path(text)
    if not path.absolute().parent.is_dir():
        raise ArgumentTypeError(f"there is no folder '{path.parent}'")
    return path
