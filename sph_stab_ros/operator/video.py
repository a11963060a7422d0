# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Videos of the camera, shared by browsers that can take the same.

There are two rungs, pictures of full and of half width, each with an encoder in a thread of its
own as long as a browser is on it; above them the camera's own video, where it sends one.
"""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from time import monotonic

from sph_stab_ros.images.codec import ImageError
from sph_stab_ros.operator.camera_video import CameraRung
from sph_stab_ros.operator.flow_control import FlowGroup, VideoFlow
from sph_stab_ros.operator.h264 import H264Encoder, SOFTWARE
from sph_stab_ros.operator.pairing import Picture
from sph_stab_ros.operator.rate_control import MIN_BIT_RATE

# With less, half of the width looks better than all of it.
MIN_FULL_BIT_RATE = 1.5e6
# Who went down comes up again for more than that.
UP_BIT_RATE = 2.2e6
FIRST_PERIOD_S, MAX_PERIOD_S, SMOOTHING = 1 / 30, 1., 0.1


class Rhythm:
    """How often something happens: ``period_s`` is smoothed."""

    def __init__(self, clock: Callable[[], float] = monotonic) -> None:
        self._clock = clock
        self._last_s = clock()
        self.period_s = FIRST_PERIOD_S

    def step(self) -> None:
        """Note that it happens; a pause is none of its periods."""
        now_s = self._clock()
        passed_s, self._last_s = now_s - self._last_s, now_s
        if passed_s < MAX_PERIOD_S:
            self.period_s += SMOOTHING * (passed_s - self.period_s)


class Rung(FlowGroup):
    """
    One encoder and the browsers, by their flows, that it encodes for.

    Its bit rate is that of the slowest, but not less than ``min_bit_rate``: below that the browser
    has to go down, so that what one can do to others is bounded. All methods are for the event
    loop's thread; ``warn`` logs a text, before which comes the kind of event, from any thread.
    The encoder may be one in hardware.
    """

    def __init__(self, divisor: int, min_bit_rate: float, warn: Callable[[str, str], object],
                 encoder_name: str) -> None:
        super().__init__()
        self._divisor, self._min_bit_rate, self._warn = divisor, min_bit_rate, warn
        self._encoder_name = encoder_name
        self._next: tuple[int, Picture] | None = None
        self._work: asyncio.Task[None] | None = None
        self._encoder: H264Encoder | None = None
        self._rhythm = Rhythm()
        self._thread = ThreadPoolExecutor(1, f'h264_{divisor}')

    def remove(self, flow: VideoFlow) -> None:
        """Let a browser go, and memory with the last one."""
        super().remove(flow)
        self._rest()

    def offer(self, sequence: int, picture: Picture) -> None:
        """Take in the camera's picture; it replaces one that has not been begun."""
        if not picture.data:
            # It will come with the next ones.
            return
        if any(flow.is_ready for flow in self._flows):
            self._next = sequence, picture
            if self._work is None or self._work.done():
                self._work = asyncio.create_task(self._encode_all())
        else:
            # What has not been encoded nobody misses.
            for flow in self._flows:
                flow.rate.stalled()

    def close(self) -> None:
        """End without waiting."""
        if self._work:
            self._work.cancel()
        self._thread.shutdown(wait=False)

    def _rest(self) -> None:
        """Give memory back when there is nothing to do."""
        if not self._flows and (self._work is None or self._work.done()):
            self._encoder = self._next = None

    async def _encode_all(self) -> None:
        """Encode while there is something new and somebody for it."""
        loop = asyncio.get_running_loop()
        while self._next and self._flows:
            (sequence, picture), self._next = self._next, None
            self._rhythm.step()
            bit_rate = max(self._min_bit_rate, min(flow.rate.bit_rate for flow in self._flows))
            wants_key = any(flow.needs_key for flow in self._flows)
            try:
                data, is_key, source_size = await loop.run_in_executor(
                    self._thread, self._encode, picture.data, bit_rate,
                    self._rhythm.period_s, wants_key)
            except ImageError as error:
                self._warn(error.reason, f'picture left out, {error}')
                continue
            encoded = replace(picture, data=data, chunk='key' if is_key else 'delta',
                              size=source_size)
            for flow in self._flows:
                flow.offer(sequence, encoded)
        self._work = None
        self._rest()

    def _encode(self, file: bytes, bit_rate: float, period_s: float, wants_key: bool
                ) -> tuple[bytes, bool, tuple[int, int]]:
        """Encode a picture, in the thread; return also the size of the file's."""
        if self._encoder is None:
            self._encoder = H264Encoder(self._divisor, self._encoder_name, self._warn)
        return (*self._encoder.encode(file, bit_rate, period_s, wants_key),
                self._encoder.source_size)


class Video:
    """Has three rungs and moves browsers to that which they can take; arguments as of a Rung."""

    def __init__(self, warn: Callable[[str, str], object], encoder_name: str = SOFTWARE) -> None:
        self._camera = CameraRung()
        self._full = Rung(1, MIN_FULL_BIT_RATE, warn, encoder_name)
        self._half = Rung(2, MIN_BIT_RATE, warn, encoder_name)
        self._flows: list[VideoFlow] = []

    def add(self, flow: VideoFlow) -> None:
        """Send a browser a video from now on."""
        self._flows.append(flow)
        self._full.add(flow)

    def remove(self, flow: VideoFlow) -> None:
        """Do so no longer."""
        self._flows.remove(flow)
        self._rung_of(flow).remove(flow)

    @property
    def needs_files(self) -> bool:
        """Tell whether anybody gets more than what the camera encodes itself."""
        return any(flow not in self._camera for flow in self._flows)

    def failed(self, flow: VideoFlow) -> None:
        """Note that a browser lacks a picture, or could not decode one."""
        flow.takes_camera = flow.takes_camera and flow not in self._camera
        flow.lose_step()

    def offer(self, sequence: int, picture: Picture) -> None:
        """Take in the camera's picture."""
        self._camera.look(picture)
        for flow in self._flows:
            rung, best = self._rung_of(flow), self._best_for(flow)
            if rung is not best:
                rung.remove(flow)
                best.add(flow)
        for rung in (self._camera, self._full, self._half):
            rung.offer(sequence, picture)

    def _rung_of(self, flow: VideoFlow) -> CameraRung | Rung:
        """Return the rung that a browser is on."""
        return next(rung for rung in (self._camera, self._full, self._half) if flow in rung)

    def _best_for(self, flow: VideoFlow) -> CameraRung | Rung:
        """Return the rung that it should be on."""
        if self._camera.suits(flow):
            return self._camera
        least = UP_BIT_RATE if flow in self._half else MIN_FULL_BIT_RATE
        return self._full if flow.rate.bit_rate >= least else self._half

    def close(self) -> None:
        """End."""
        self._full.close()
        self._half.close()
