# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The camera's own video, for browsers that can take all of it: its encoder is the camera."""

from dataclasses import replace

from sph_stab_ros.operator.flow_control import FlowGroup, VideoFlow
from sph_stab_ros.operator.pairing import Picture

# Who has come down to this share of the camera's bit rate leaves.
ENOUGH = 0.8


class CameraRung(FlowGroup):
    """
    Browsers, by their flows, that get the packets of the camera as they are.

    Nobody can ask a camera for a key picture. So a browser comes when there is one, and who misses
    a packet leaves at once, for an encoder of ours. ``bit_rate`` is that of the last group of
    pictures, from one key picture to the next, None where packets of it were missing.
    """

    def __init__(self) -> None:
        super().__init__()
        self.bit_rate: float | None = None
        self._number = 0
        # Of the group of pictures that goes on, None where packets of it are missing.
        self._begin_s: float | None = None
        self._bytes = 0
        self._is_key = False

    def look(self, picture: Picture) -> None:
        """Take in what the camera has sent, before it is offered."""
        packet = picture.packet
        follows = packet is not None and packet.number == self._number + 1
        self._is_key = packet is not None and packet.chunk == 'key'
        if self._is_key:
            passed_s = picture.received_s - self._begin_s \
                if follows and self._begin_s is not None else 0.
            self.bit_rate = 8 * self._bytes / passed_s if passed_s > 0 else None
            self._begin_s, self._bytes = picture.received_s, 0
        elif not follows:
            self.bit_rate = self._begin_s = None
            for flow in self._flows:
                flow.lose_step()
        if packet:
            self._number = packet.number
            self._bytes += len(packet.data)

    def suits(self, flow: VideoFlow) -> bool:
        """Tell whether a browser is to get what was looked at last."""
        if flow in self._flows:
            return flow.is_in_step and flow.rate.bit_rate >= ENOUGH * (self.bit_rate or 0.)
        return (self._is_key and self.bit_rate is not None and flow.is_ready
                and flow.takes_camera and flow.rate.bit_rate >= self.bit_rate)

    def offer(self, sequence: int, picture: Picture) -> None:
        """Send what was looked at last."""
        if packet := picture.packet:
            passed = replace(picture, data=packet.data, chunk=packet.chunk, codec=packet.codec,
                             packet=None)
            for flow in self._flows:
                flow.offer(sequence, passed)
