# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The images of two lenses on two topics, which are joined into one picture each."""

from collections.abc import Callable
from functools import partial
from threading import Lock
from typing import Any

from rclpy.node import Node
from sph_stab_ros.config import NodeConfig
from sph_stab_ros.images.joined import Pairing
from sph_stab_ros.ros.diagnostics import Diagnostics
from sph_stab_ros.ros.image_input import ImageInput, ReceivedImage

TOPICS = 'image', 'image_rear'


class JoinedInput:
    """
    Two ImageInputs, on ``image`` and ``image_rear``, whose images are paired by their stamps.

    To the node it is what one ImageInput is, with its parameters.
    """

    def __init__(self, node: Node, config: NodeConfig, take: Callable[[ReceivedImage], None],
                 diagnostics: Diagnostics) -> None:
        self._take, self._join = take, config.join
        self._pairing: Pairing[ReceivedImage] = Pairing()
        # Video is decoded in a thread for each topic.
        self._lock = Lock()
        self._inputs = [ImageInput(node, config, partial(self._pair, which), diagnostics, topic)
                        for which, topic in enumerate(TOPICS)]
        self.name = ' and '.join(one.name for one in self._inputs)

    @property
    def dropped(self) -> int:
        """Return how many images were not used, those without one of the other lens included."""
        return self._pairing.left_out + sum(one.dropped for one in self._inputs)

    def why_silent(self) -> str:
        """Return why nothing comes from either lens, '' where something does."""
        return '; '.join(filter(None, (one.why_silent() for one in self._inputs)))

    def state(self) -> dict[str, Any]:
        """Return how many images have none of the other lens with them."""
        return {'one_lens_only': str(self._pairing.left_out)}

    def start(self) -> None:
        """Start to decode."""
        for one in self._inputs:
            one.start()

    def close(self) -> None:
        """Let the decoders finish their pictures, and stop."""
        for one in self._inputs:
            one.close()

    def _pair(self, which: int, image: ReceivedImage) -> None:
        with self._lock:
            pair = self._pairing.add(which, image.stamp_ns, image)
            if pair is not None:
                first, second = pair
                self._take(first._replace(
                    other=second.content, join=self._join,
                    received_s=max(first.received_s, second.received_s)))
