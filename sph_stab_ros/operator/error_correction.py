# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
A message in pieces, each for a datagram, and spare ones, from which lost ones are made again.

Pieces are in groups. Of each group any two may get lost: its two spare ones are P and Q of RAID 6,
that is, of its pieces d_i in GF(256), polynomial 0x11d, the sums of d_i and of 2^i d_i. Groups
interleave, since what gets lost together has mostly been sent one behind the other.
"""

from struct import pack

import numpy as np

# With what HTTP/3, QUIC and IP put around it, within the 1280 bytes that every way takes.
PIECE_BYTES = 1100
# How many a group has at most without the spare ones, by the share of packets that get lost: three
# do in less than one of 200 groups.
GROUP_PIECES = (0.015, 20), (0.035, 8), (1., 4)
HEADER = '<IIIHB'


def group_pieces(loss: float) -> int:
    """Return how many pieces there are to be in a group."""
    return next(count for most, count in GROUP_PIECES if loss <= most)


def pieces(number: int, after: int, message: bytes, per_group: int) -> list[bytes]:
    """
    Return the pieces of a message, in the order in which they are to be sent.

    Each begins with HEADER: the number of the message, that of the one it can be used after, 0
    where it needs none, its length, the index of the piece, and ``per_group``, how many pieces a
    group has at most without the spare ones. Piece ``i`` is of group ``i % groups``; behind the
    message's own come P and Q of each group in turn.
    """
    count = -(-len(message) // PIECE_BYTES)
    groups = -(-count // per_group)
    padded = np.zeros((count, PIECE_BYTES), np.uint8)
    padded.flat[:len(message)] = np.frombuffer(message, np.uint8)
    padded = padded[:, :len(message)]
    cut = [message[start:start + PIECE_BYTES] for start in range(0, len(message), PIECE_BYTES)]
    for group in range(groups):
        own = padded[group::groups]
        cut += [np.bitwise_xor.reduce(own).tobytes(), weighted_sum(own).tobytes()]
    return [pack(HEADER, number, after, len(message), index, per_group) + piece
            for index, piece in enumerate(cut)]


def weighted_sum(rows: np.ndarray) -> np.ndarray:
    """Return the sum of 2^i times row i of bytes (n, m) in GF(256), (m,)."""
    total = np.zeros_like(rows[0])
    for row in rows[::-1]:
        total = (total << 1) ^ (total >> 7) * np.uint8(0x1d) ^ row
    return total
