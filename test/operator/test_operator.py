# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The operator's page without server and browser: pairing, protocol, command line."""

from collections import Counter
from dataclasses import asdict
import json
from struct import unpack_from

import numpy as np
import pytest

pytest.importorskip('aiohttp', reason='aiohttp is not installed')
from operator_site import BAD, picture  # noqa: E402, I100
from sph_stab_ros.operator.pairing import (  # noqa: E402
    MAX_WAITING, Orientation, Pairing, Picture, SILENCE_S, StampedOrientations)
from sph_stab_ros.operator.protocol import (  # noqa: E402
    COMMANDS, Look, parse_command, picture_message, ProtocolError)


class Clock:
    """A clock that stands still unless it is moved."""

    def __init__(self):
        self.now_s = 100.

    def __call__(self):
        """Return the time in seconds."""
        return self.now_s


def orientation(number):
    """Return an Orientation that can be told from others."""
    return Orientation((0., 0., 0., 1.), (float(number), 0., 0., 0.))


# Pairing.

@pytest.mark.parametrize('seed', range(20))
def test_every_picture_has_the_orientation_of_its_stamp(seed):
    rng = np.random.default_rng(seed)
    paired = []
    pairing = Pairing(paired.append, Clock())
    pairing.add_orientation(1, orientation(1))
    # Each arrives late by its own delay; the node leaves some pictures out.
    events = [(n + rng.uniform(0, 5), 'picture', n) for n in range(2, 200)]
    events += [(n + rng.uniform(0, 5), 'orientation', n) for n in range(2, 200)
               if rng.random() < 0.8]
    in_order = {'picture': [], 'orientation': []}
    for time_s, kind, n in sorted(events, key=lambda event: event[2]):
        # The middleware keeps each topic in order.
        time_s = max([time_s, *(at_s for at_s, _ in in_order[kind][-1:])])
        in_order[kind].append((time_s, n))
    for _, kind, n in sorted((time_s, kind, n) for kind, list_ in in_order.items()
                             for time_s, n in list_):
        if kind == 'picture':
            pairing.add_picture(picture(n))
        else:
            pairing.add_orientation(n, orientation(n))
    assert [one.stamp_ns for one in paired] == [n for _, n in in_order['orientation']]
    assert all(one.orientation == orientation(one.stamp_ns) for one in paired)


def test_pictures_go_out_alone_when_no_node_answers():
    emitted, clock = [], Clock()
    pairing = Pairing(emitted.append, clock)
    pairing.add_picture(picture(1))
    clock.now_s += SILENCE_S
    pairing.add_picture(picture(2))
    pairing.add_orientation(3, orientation(3))
    # A camera that pauses says nothing of the node.
    clock.now_s += 10 * SILENCE_S
    pairing.add_picture(picture(4))
    assert [one.stamp_ns for one in emitted] == [2]
    clock.now_s += SILENCE_S
    pairing.add_picture(picture(5))
    pairing.add_picture(picture(6))
    assert [(one.stamp_ns, one.orientation) for one in emitted] == [
        (2, None), (5, None), (6, None)]


def test_a_server_that_has_just_started_knows_nothing_of_the_node_s_silence():
    """Nor does one whose camera has."""
    emitted, clock = [], Clock()
    pairing = Pairing(emitted.append, clock)
    pairing.add_picture(picture(1))
    clock.now_s += SILENCE_S / 2
    pairing.add_orientation(1, orientation(1))
    assert emitted == [Picture(1, picture(1).data, 0., orientation(1))]


def test_what_waits_is_bounded():
    emitted = []
    pairing = Pairing(emitted.append, Clock())
    pairing.add_orientation(1, orientation(1))
    for n in range(2, 10 * MAX_WAITING):
        pairing.add_picture(picture(n))
    pairing.add_orientation(2, orientation(2))
    assert not emitted


def test_a_camera_without_stamps_gets_the_newest_picture():
    emitted = []
    pairing = Pairing(emitted.append, Clock())
    pairing.add_orientation(1, orientation(1))
    for size in (1, 2, 3):
        pairing.add_picture(picture(0, size))
    pairing.add_orientation(99, orientation(99))
    assert [(one.data, one.orientation) for one in emitted] == [
        (picture(0, 3).data, orientation(99))]


@pytest.mark.parametrize('seed', range(20))
def test_both_orientations_of_a_stamp_come_together(seed):
    """Each topic keeps its order, one hardly before the other; one is heard later at first."""
    rng = np.random.default_rng(seed)
    complete = []
    stamped = StampedOrientations(lambda stamp_ns, both: complete.append((stamp_ns, both)))
    camera, virtual = (list(range(first, 200)) for first in rng.integers(0, 20, 2))
    while camera or virtual:
        ahead = len(virtual) - len(camera)
        first = rng.random() < 0.5 if abs(ahead) < MAX_WAITING else ahead < 0
        kind, left = ('R_world_camera', camera) if first else ('R_world_virtual', virtual)
        if left:
            n = left.pop(0)
            stamped.add(n, **{kind: (kind, n)})
    assert complete[-1][0] == 199
    for n, both in complete:
        assert both == Orientation(('R_world_camera', n), ('R_world_virtual', n))
    stamps_ns = [n for n, _ in complete]
    assert stamps_ns == sorted(set(stamps_ns))


def test_orientations_that_stay_alone_are_bounded_and_forgotten():
    complete = []
    stamped = StampedOrientations(lambda stamp_ns, both: complete.append(stamp_ns))
    for n in range(10 * MAX_WAITING):
        stamped.add(n, R_world_camera=n)
    stamped.add(1, R_world_virtual=1)
    assert not complete
    stamped.add(n, R_world_virtual=n)
    # Another loop of the same bag.
    stamped.add(n - 1, R_world_virtual=n - 1)
    assert complete == [n]


# Protocol.

@pytest.mark.parametrize('of', [orientation(3), None])
def test_picture_message(of):
    stamp_ns = 2**63 - 1
    message = picture_message(7, Picture(stamp_ns, b'\xff\xd8picture', 0., of))
    length, = unpack_from('<I', message)
    header = json.loads(message[4:4 + length])
    assert message[4 + length:] == b'\xff\xd8picture'
    assert header['sequence'] == 7 and int(header['stamp_ns']) == stamp_ns
    assert header['orientation'] == (of and json.loads(json.dumps(asdict(of))))


def test_commands_of_the_page():
    direction = [0.6, 0., 0., 0.8001]
    look = parse_command(json.dumps({'type': 'look', 'direction': direction}))
    assert isinstance(look, Look)
    assert np.linalg.norm(look.direction) == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(look.direction, direction, atol=1e-3)
    assert parse_command('{"type": "drawn", "sequence": 3}').sequence == 3
    assert parse_command('{"type": "set_mode", "mode": "lock"}').mode == 'lock'


@pytest.mark.parametrize('text', BAD)
def test_other_texts_are_refused(text):
    with pytest.raises(ProtocolError):
        parse_command(text)


def test_no_text_does_more_than_be_refused():
    rng = np.random.default_rng(0)
    whole = [json.dumps({'type': 'look', 'direction': [0, 0, 0, 1]}),
             json.dumps({'type': 'drawn', 'sequence': 12}),
             json.dumps({'type': 'set_mode', 'mode': 'follow'})]
    outcomes = Counter()
    for n in range(3000):
        text = bytearray(whole[n % 3].encode())
        for _ in range(rng.integers(1, 4)):
            text[rng.integers(len(text))] = rng.integers(32, 127)
        try:
            outcomes[type(parse_command(text.decode()))] += 1
        except ProtocolError:
            outcomes['refused'] += 1
    assert outcomes['refused'] > 1000
    assert outcomes.keys() - {'refused'} <= set(COMMANDS.values())


# Command line.

@pytest.mark.parametrize('arguments', [
    ['--port', 'x'], ['--port', '70000'], ['--browsers', '0'], ['--colour', 'red'],
    ['--encoder', 'crayon'],
    ['--token-file', '/nowhere'], ['--key', 'x'], ['--certificate', 'x', '--insecure'],
    ['--ros-args', '-r', 'x']])
def test_wrong_calls(arguments, capsys):
    pytest.importorskip('rclpy', reason='rclpy is not installed')
    from sph_stab_ros.operator.__main__ import main
    try:
        status = main(arguments)
    except SystemExit as ending:
        status = ending.code
    said = capsys.readouterr().err
    assert status == 2
    assert len(said.splitlines()) == 1 and said.startswith('operator: ')


def test_addresses():
    pytest.importorskip('rclpy', reason='rclpy is not installed')
    from sph_stab_ros.operator.__main__ import address
    assert address('127.0.0.1', 80, False) == 'http://127.0.0.1:80/'
    assert address('::1', 80, True) == 'https://[::1]:80/'
    assert '0.0.0.0' not in address('0.0.0.0', 80, True)
