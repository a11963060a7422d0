# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Inputs that went wrong on their way: valid files with bits flipped, lengths changed, parts lost.

``make fuzz`` runs the tests in ``test/fuzz`` again and again with other seeds (``run_fuzz.py``),
``make test`` a few examples of each, always the same.
"""

import atexit
from collections import Counter
from contextlib import contextmanager
from functools import cache
import hashlib
import os
from pathlib import Path
import resource
import traceback

from hypothesis import settings, strategies as st

# Where inputs are kept that fail, and before that the one that is being tried.
FOLDER = os.environ.get('FUZZ_FOLDER')
MOST_OPERATIONS = 4
# What one input may take more than those before.
MOST_GROWTH_KIB = 2**20
NUMBERS = (0, 1, 2, 3, 7, 8, 0x7f, 0x80, 0xff, 0x100, 0x7fff, 0x8000, 0xffff, 0x10000, 0x7fffffff,
           0x80000000, 0xfffffffe, 0xffffffff, 0x100000000, 0x7fffffffffffffff,
           0x8000000000000000, 0xffffffffffffffff)


def examples(count):
    """Return settings with so many examples in ``make test``; ``make fuzz`` has its own."""
    default = settings.default
    return settings(max_examples=count if default.derandomize else default.max_examples)


@contextmanager
def tried(name, data):
    """Try an input, bytes or text; where the block fails it stays behind in FOLDER."""
    if FOLDER is None:
        yield
        return
    count_examples()
    if isinstance(data, str):
        data = data.encode(errors='surrogatepass')
    # Whoever watches finds it there, even if the process does not live to tell.
    present = Path(FOLDER) / f'{name}.present'
    present.write_bytes(data)
    before_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        yield
        grown_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kib
        assert grown_kib < MOST_GROWTH_KIB, f'{grown_kib / 2**20:.1f} GiB of memory'
    except Exception:
        kept = present.with_name(f'{name}-{hashlib.sha1(data).hexdigest()[:8]}')
        kept.with_suffix('.input').write_bytes(data)
        kept.with_suffix('.txt').write_text(traceback.format_exc())
        raise
    finally:
        present.unlink()


@cache
def examples_tried():
    """Return the counter of examples, which is written at the end."""
    counter = Counter()
    atexit.register(lambda: (Path(FOLDER) / 'examples').write_text(str(counter.total())))
    return counter


def count_examples():
    """Count one."""
    examples_tried()['all'] += 1


def mutated(*valid, hot=None):
    """
    Return a strategy for what becomes of one of the ``valid`` inputs, bytes.

    Half of the places are near those that ``hot(valid)`` returns, such as fields of lengths.
    """
    def of(data):
        places = st.integers(0, max(len(data) - 1, 0))
        if hot is not None:
            near = st.tuples(st.sampled_from(hot(data)), st.integers(-4, 12)).map(sum).map(
                lambda at: min(max(at, 0), len(data) - 1))
            places = near | places
        return st.lists(operations(places), min_size=1, max_size=MOST_OPERATIONS).map(
            lambda found: applied(data, found))
    return st.sampled_from(valid).flatmap(of)


def operations(places):
    """Return a strategy for functions of a bytearray that change it in place."""
    lengths = st.integers(1, 64) | st.integers(1, 5000)
    widths, orders = st.sampled_from((1, 2, 4, 8)), st.sampled_from(('little', 'big'))
    return st.one_of(
        st.builds(Flip, places, st.integers(0, 7)),
        st.builds(Number, places, widths, orders, st.sampled_from(NUMBERS)),
        st.builds(Add, places, widths, orders, st.integers(-9, 9)),
        st.builds(Insert, places, st.binary(max_size=16)),
        st.builds(Overwrite, places, st.binary(min_size=1, max_size=16)),
        st.builds(Zero, places, lengths),
        st.builds(Delete, places, lengths),
        st.builds(Repeat, places, lengths, st.integers(1, 20)),
        st.builds(Cut, places))


def applied(data, found):
    """Return ``data`` after some operations."""
    changed = bytearray(data)
    for one in found:
        one(changed)
    return bytes(changed)


class Operation:
    """Something that changes a bytearray; shown by its arguments."""

    def __init__(self, *arguments):
        self.arguments = arguments

    def __call__(self, data):
        """Change it in place."""
        self.change(data, *self.arguments)

    def __repr__(self):
        return f'{type(self).__name__}{self.arguments}'


class Flip(Operation):
    """One bit."""

    def change(self, data, at, bit):
        """Do it."""
        if at < len(data):
            data[at] ^= 1 << bit


class Number(Operation):
    """Another number, in the place of a length perhaps."""

    def change(self, data, at, width, order, value):
        """Do it."""
        data[at:at + width] = (value % 256**width).to_bytes(width, order)


class Add(Operation):
    """A number that is a little off."""

    def change(self, data, at, width, order, by):
        """Do it."""
        value = int.from_bytes(data[at:at + width], order) + by
        data[at:at + width] = (value % 256**width).to_bytes(width, order)


class Insert(Operation):
    """Bytes that do not belong there."""

    def change(self, data, at, more):
        """Do it."""
        data[at:at] = more


class Overwrite(Operation):
    """Other bytes."""

    def change(self, data, at, other):
        """Do it."""
        data[at:at + len(other)] = other


class Zero(Operation):
    """A sector that was never written."""

    def change(self, data, at, length):
        """Do it."""
        data[at:at + length] = bytes(len(data[at:at + length]))


class Delete(Operation):
    """A part that is lost."""

    def change(self, data, at, length):
        """Do it."""
        del data[at:at + length]


class Repeat(Operation):
    """A part that is there again."""

    def change(self, data, at, length, times):
        """Do it."""
        data[at:at] = data[at:at + length] * times


class Cut(Operation):
    """An end that is missing."""

    def change(self, data, at):
        """Do it."""
        del data[at:]
