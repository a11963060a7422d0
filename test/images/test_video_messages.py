# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Video in messages: decoded as a whole stream is, or not at all, and then with a word."""

from encoded_video import (
    check_right, CLOSED, codec_of, COUNT, given_pictures, KEY_PERIOD, keys, message, MESSAGES,
    outcomes, pictures, reasons, stream, STREAMS)
from hypothesis import given, strategies
import numpy as np
import pytest
from sph_stab_ros.images.codec import ImageError
from sph_stab_ros.images.message_decoder import MessageDecoder
from sph_stab_ros.images.picture_time import Stamp
from sph_stab_ros.images.video.decoder import CODECS, DAMAGED, MISSING, NO_KEY


@pytest.mark.parametrize('make', MESSAGES.values(), ids=MESSAGES)
@pytest.mark.parametrize('name', STREAMS)
def test_messages_give_the_pictures_of_their_stream(name, make):
    """In the order of presentation, each with what stands for its own message."""
    said = []
    shown = given_pictures(outcomes(stream(name), name, make, said))
    assert list(shown) == list(range(COUNT)) and not said
    check_right(shown, name)


@pytest.mark.parametrize('name', CLOSED)
def test_decoding_begins_with_a_key_picture_wherever_it_is_begun(name):
    packets = stream(name)
    for start in range(len(packets)):
        said, first = [], min((at for at in keys(name) if at >= start), default=COUNT)
        found = outcomes(packets[start:], name, said=said)
        shown = given_pictures(found)
        assert list(shown) == sorted(index for index, _ in packets[first:])
        check_right(shown, name)
        assert reasons(found) == (first - start) * [NO_KEY]
        assert len(said) == (first > start)
        assert not said or said[0].endswith(f': {first - start}'), said


@pytest.mark.parametrize('name', STREAMS)
def test_no_picture_is_made_of_a_missing_one(name):
    """Whichever message is lost, or how many: all others are right, or told of."""
    packets = stream(name)
    for lost in range(1, len(packets)):
        # What comes a whole period of keys later has the numbers that are expected; how long
        # that is has to be known first.
        for count in (1, 2, *((KEY_PERIOD, KEY_PERIOD + 1) if lost > KEY_PERIOD else ())):
            rest = packets[:lost] + packets[lost + count:]
            found = outcomes(rest, name)
            assert {index for index, _ in found} == {index for index, _ in rest}
            shown = given_pictures(found)
            check_right(shown, name)
            # What was decoded before is not given up.
            assert {index for index, _ in packets[:lost]} <= shown.keys()


@pytest.mark.parametrize('name', CLOSED)
def test_a_lost_picture_that_others_need_is_told_of_up_to_the_next_key_picture(name):
    packets, at = stream(name), 1
    said = []
    found = outcomes(packets[:at] + packets[at + 1:], name, said=said)
    shown = given_pictures(found)
    assert {index for index, _ in packets[KEY_PERIOD:]} <= shown.keys()
    told = reasons(found)
    assert told and set(told) <= {MISSING, NO_KEY, DAMAGED}
    assert said == [f'{CODECS[codec_of(name)].name}: pictures passed over before a '
                    f'key picture: {len(told)}']


@pytest.mark.parametrize('name', [name for name in CLOSED if 'B' not in name])
def test_without_pictures_in_between_none_waits(name):
    """Each message gives its picture at once."""
    decoder = MessageDecoder([].append)
    for index, data in stream(name):
        (shown, _), = decoder.decode(message(data, codec_of(name)), index, Stamp(0))
        assert shown == index


@pytest.mark.parametrize('share', [0.02, 0.5, 0.97])
@pytest.mark.parametrize('name', ['h264', 'h264 B', 'av1'])
def test_a_message_that_is_cut_shows_nothing_and_all_is_right_again_with_a_key_picture(
        name, share):
    """H.265's decoder does not notice where a picture ends."""
    packets = stream(name)
    for at in range(len(packets)):
        index, data = packets[at]
        cut = [*packets[:at], (index, data[:int(share * len(data))]), *packets[at + 1:]]
        found = outcomes(cut, name)
        shown = given_pictures(found)
        if name == 'h264 B' and index in shown:
            # Arithmetic coding makes something of any bits.
            continue
        assert index not in shown
        check_right(shown, name)
        following = min((key for key in keys(name) if key > at), default=COUNT)
        assert {index for index, _ in packets[following:]} <= shown.keys()


@given(strategies.data())
@pytest.mark.parametrize('name', ['h264 B', 'h265 B', 'av1 hidden'])
def test_no_damage_is_more_than_a_picture_without_one(name, data):
    """Bytes overwritten, cut or inserted anywhere; with a key picture all is right again."""
    packets = list(stream(name))
    at = data.draw(strategies.integers(0, KEY_PERIOD - 1))
    index, content = packets[at]
    start = data.draw(strategies.integers(0, len(content)))
    end = data.draw(strategies.integers(start, min(start + 9, len(content))))
    packets[at] = index, content[:start] + data.draw(strategies.binary(max_size=9)) + content[end:]
    shown = dict(outcomes(packets, name))
    for index, _ in packets[KEY_PERIOD:]:
        assert np.array_equal(shown[index].image, pictures(name)[index])


@given(strategies.lists(strategies.binary(max_size=60), max_size=4),
       strategies.sampled_from(['h264', 'h265', 'av1']), strategies.booleans())
def test_whatever_comes_is_a_picture_or_an_image_error(contents, codec, starts):
    decoder = MessageDecoder([].append)
    for content in contents:
        data = b'\0\0\1' + content if starts else content
        for _, source in decoder.decode(message(data, codec), 0, Stamp(0)):
            assert isinstance(source, ImageError)
