# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Messages in pieces: what the page makes again of those that got lost is what was sent."""

from base64 import b64decode, b64encode
from itertools import combinations
from random import Random
from struct import pack

import pytest
from sph_stab_ros.operator.error_correction import group_pieces, HEADER, PIECE_BYTES, pieces

pytest.importorskip('rclpy', reason='rclpy is not installed')
from bare_page import bare_page  # noqa: E402, I100

pytestmark = pytest.mark.browser

# Of one piece, of some, of two groups and of three that are not full.
PER_GROUP = 20
LENGTHS = [1, PIECE_BYTES, PIECE_BYTES + 1, 3 * PIECE_BYTES - 7,
           2 * PER_GROUP * PIECE_BYTES, 2 * PER_GROUP * PIECE_BYTES + 5]
# Hears datagrams; tells what can be used, and how far it is.
HEAR = """async datagrams => {
    const {Messages} = await import('/error_correction.js'), got = [];
    const messages = new Messages(one => got.push(one.toBase64 ? one.toBase64()
        : btoa(Array.from(one, value => String.fromCharCode(value)).join(''))));
    for (const one of datagrams) {
        messages.hear(Uint8Array.from(atob(one), letter => letter.charCodeAt(0)));
    }
    return [got, messages.usable, messages.newest];
}"""


@pytest.fixture(scope='module')
def hear():
    """Return what lets a browser hear datagrams: the messages, the last usable, the newest."""
    with bare_page() as page:
        def hear(datagrams):
            got, usable, newest = page.evaluate(
                HEAR, [b64encode(one).decode() for one in datagrams])
            return list(map(b64decode, got)), usable, newest
        yield hear


def groups(length, per_group):
    """Return the indices of the pieces of each group."""
    count = -(-length // PIECE_BYTES)
    of_groups = -(-count // per_group)
    return [[*range(group, count, of_groups), count + 2 * group, count + 2 * group + 1]
            for group in range(of_groups)]


@pytest.mark.parametrize('per_group', [1, 4, PER_GROUP])
@pytest.mark.parametrize('length', LENGTHS)
def test_any_two_of_each_group_may_get_lost(hear, length, per_group):
    random = Random(length)
    message = random.randbytes(length)
    sent, own = pieces(7, 0, message, per_group), groups(length, per_group)
    assert sorted(sum(own, [])) == list(range(len(sent)))
    # Within what a QUIC packet of 1200 bytes takes.
    assert max(map(len, sent)) < 1150
    pairs = [list(combinations(group, 2)) for group in own]
    for n in range(max(map(len, pairs))):
        lost = {index for one in pairs for index in one[n % len(one)]}
        left = [one for index, one in enumerate(sent) if index not in lost]
        random.shuffle(left)
        assert hear(left) == ([message], 7, 7), lost


def test_with_three_lost_there_is_no_message_and_none_that_needs_it(hear):
    random = Random(3)
    first, second, third, key, last = (random.randbytes(9000 + n) for n in range(5))
    late = pieces(2, 1, second, PER_GROUP)
    sent = [pieces(1, 0, first, PER_GROUP), late[3:], pieces(4, 2, third, PER_GROUP)]
    assert hear(sum(sent, [])) == ([first], 1, 4)
    sent += [pieces(5, 0, key, PER_GROUP), pieces(9, 5, last, PER_GROUP)]
    assert hear(sum(sent, [])) == ([first, key, last], 9, 9)
    # Nor does what comes late, or twice, count.
    assert hear(sum(sent, []) + late + sum(sent, [])) == ([first, key, last], 9, 9)


def test_the_order_in_which_pieces_come_does_not_matter(hear):
    messages = [Random(n).randbytes(1 + 5000 * n) for n in range(5)]
    for seed in range(10):
        sent = [piece for n, one in enumerate(messages, 1) for piece in pieces(n, n - 1, one, 4)]
        Random(seed).shuffle(sent)
        assert hear(sent) == (messages, 5, 5)


def test_garbage_gives_nothing_and_hinders_nothing(hear):
    random = Random(0)
    message = random.randbytes(5000)
    sent = pieces(3, 0, message, PER_GROUP)
    garbage = [random.randbytes(random.randrange(1200)) for _ in range(200)]
    garbage += [one[:random.randrange(len(one))] for one in sent]
    garbage += [sent[0] + b'x', *(pack(HEADER, *values) + bytes(size) for size in (0, 1, 1100)
                                  for values in (
                                          (3, 3, 5000, 0, 20), (3, 0, 0, 0, 20), (0, 0, 1, 0, 20),
                                          (3, 2, 4999, 0, 20), (3, 0, 5000, 999, 20),
                                          (3, 0, 5000, 0, 0), (3, 0, 5000, 0, 4),
                                          (3, 0, 2**32 - 1, 0, 20)))]
    got, _, _ = hear(sent[:1] + garbage + sent[1:])
    assert got == [message]


def test_nothing_is_heard_of_garbage_alone(hear):
    random = Random(1)
    assert hear([random.randbytes(random.randrange(1200)) for _ in range(300)]) == ([], 0, 0)


def test_the_more_get_lost_the_more_are_spare():
    assert [group_pieces(loss) for loss in (0., 0.01, 0.03, 0.1, 1.)] == [20, 20, 8, 4, 4]
