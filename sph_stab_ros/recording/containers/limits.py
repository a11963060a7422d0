# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
What keeps a file that was made to mislead from taking all time or memory.

Damage, or somebody who means ill, can make small files say that they hold more than any memory, or
look like the beginnings of a million records that reach to the end. All bounds are far beyond what
recordings have.
"""

from typing import Any

# What one chunk or one compressed message may become.
MOST_UNPACKED_BYTES = 2**29
# How much is read of a file, for each of its bytes and besides, before the search for records in
# it is given up; of heads, a page is read for a few bytes.
READ_FOR_EACH, READ_BESIDES = 128, 2**28
# How many chunks that reach beyond the end are read as far as they go: one is the last one.
MOST_CUT_CHUNKS = 16
# How many records a file may hold, for each of its bytes and besides.
RECORDS_FOR_EACH, RECORDS_BESIDES = 1, 2**22
# How many texts about damage are kept.
MOST_TOLD = 1000


class Damaged(Exception):
    """Content ends too early, or contradicts itself."""


class Damage(list[str]):
    """Texts about what is damaged, the first ones only."""

    def append(self, text: str) -> None:
        """Keep a text, unless there are too many."""
        if len(self) < MOST_TOLD:
            super().append(text)


def unpacked(decompressor: Any, data: bytes, most_bytes: int = MOST_UNPACKED_BYTES) -> bytes:
    """Return what a decompressor makes of ``data``; Damaged where that is more than so much."""
    if most_bytes > MOST_UNPACKED_BYTES:
        raise Damaged(f'{most_bytes} bytes at once')
    # One more shows that there are too many.
    content: bytes = decompressor.decompress(data, max_length=most_bytes + 1)
    if len(content) > most_bytes:
        raise Damaged(f'more than {most_bytes} bytes')
    return content
