# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Video of which pictures get lost: what a browser is sent can be used again soon."""

from collections import deque
from dataclasses import replace
from random import Random

import pytest

pytest.importorskip('aiohttp', reason='aiohttp is not installed')
from operator_site import picture  # noqa: E402, I100
from sph_stab_ros.operator.flow_control import (  # noqa: E402
    KEY_PERIOD_S, MAX_QUEUE_S, VideoFlow)
from sph_stab_ros.operator.protocol import Arrived  # noqa: E402

PERIOD_S, ONE_WAY_S, TELL_S = 0.03, 0.02, 0.1


class LossyLink:
    """A flow, and a page at the other end of a link that loses ``loss`` of either direction."""

    def __init__(self, seed):
        self.now_s, self.loss = 100., 0.
        self._random = Random(seed)
        self.flow = VideoFlow(lambda: None, lambda: self.now_s)
        self._sequence = self._last = self._told_s = 0
        # When each arrives, and what is to be done then.
        self._on_the_way = deque()
        # What the page has, as Messages of error_correction.js: by number what each needs.
        self._whole, self.usable, self.newest = {}, 0, 0
        self.used = []

    def run(self, seconds):
        """Film for so long."""
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += PERIOD_S
            while self._on_the_way and self._on_the_way[0][0] <= self.now_s:
                self._on_the_way.popleft()[1]()
            self._film()
            if self.now_s > self._told_s + TELL_S:
                self._told_s = self.now_s
                self._tell()

    def _send(self, action):
        if self._random.random() >= self.loss:
            self._on_the_way.append((self.now_s + ONE_WAY_S, action))

    def _film(self):
        self._sequence += 1
        self.flow.offer(self._sequence, replace(
            picture(self._sequence), chunk='key' if self.flow.needs_key else 'delta'))
        if numbered := self.flow.next_picture():
            number, sent = numbered
            after = 0 if sent.chunk == 'key' else self._last
            self._last = number
            self._send(lambda: self._take(number, after))

    def _take(self, number, after):
        self.newest = max(self.newest, number)
        self._whole[number] = after
        while usable := [one for one, needs in self._whole.items()
                         if one > self.usable and needs in (0, self.usable)]:
            self.usable = max(usable)
            self.used.append(self.usable)
            drawn = self.usable
            self._send(lambda: self.flow.acknowledge(drawn))

    def _tell(self):
        told, drawn = Arrived(self.usable, self.newest), self.usable
        self._send(lambda: self.flow.acknowledge(drawn))
        self._send(lambda: self.flow.arrived(told.sequence, told.newest))


@pytest.mark.parametrize('seed', range(20))
def test_pictures_can_be_used_again_soon_whatever_got_lost(seed):
    link = LossyLink(seed)
    link.run(1)
    assert len(link.used) > 25
    for loss in (0.1, 0.5, 1.):
        link.loss = loss
        link.run(3)
        link.loss = 0
        # The last key picture may just have been lost.
        link.run(KEY_PERIOD_S + MAX_QUEUE_S + 0.3)
        before = len(link.used)
        link.run(1)
        assert len(link.used) > before + 25


def test_after_an_outage_a_key_picture_comes_at_once():
    link = LossyLink(0)
    link.run(2)
    link.loss = 1.
    link.run(2)
    link.loss, before = 0., len(link.used)
    # The page tells where it is; there and back, and a picture.
    link.run(TELL_S + 2 * ONE_WAY_S + 3 * PERIOD_S)
    assert len(link.used) > before


def test_one_lost_picture_costs_one_key_picture():
    link = LossyLink(0)
    link.run(2)
    link.loss = 1.
    link.run(PERIOD_S)
    link.loss = 0.
    before = link.flow._key
    link.run(3)
    keys = {number for number, after in link._whole.items() if after == 0 and number > before}
    assert len(keys) == 1


def test_without_loss_there_is_no_other_key_picture():
    link = LossyLink(0)
    link.run(5)
    assert [number for number, after in link._whole.items() if after == 0] == [1]
