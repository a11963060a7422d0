# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The images of a camera or stream that the node reads itself, past the middleware."""

from collections.abc import Callable
from time import monotonic
from typing import Any

from rclpy.node import Node
from sph_stab_ros.config import ConfigError, NodeConfig, NOT_JOINED
from sph_stab_ros.images.image_error import ImageError
from sph_stab_ros.live.address import Address, address_of, file_of, Kind, PLAYED, SourceError
from sph_stab_ros.live.joined import source_of
from sph_stab_ros.live.source import LivePicture
from sph_stab_ros.recording import RecordingError
from sph_stab_ros.recording.spherical import boxes_say, InBoxes, layout_of
from sph_stab_ros.ros.diagnostics import Diagnostics
from sph_stab_ros.ros.image_input import ReceivedImage


def source_address(text: str, options: str) -> Address:
    """Return the Address in a text; SourceError also where it is of a file that is no video."""
    address = address_of(text, options)
    if address.kind is Kind.FILE:
        # What reads bags is asked for by nobody else in the node.
        from sph_stab_ros.recording.containers.kinds import kind_of, refuse_if_known
        try:
            refuse_if_known(file_of(address))
            is_bag = kind_of(file_of(address)) is not None
        except (OSError, RecordingError) as error:
            raise SourceError(f'source: {error}') from None
        if is_bag:
            raise SourceError(f"source: '{address.name}' is a bag; {PLAYED}")
    return address


class SourceInput:
    """
    Reads the node's ``source``; to the node it is what an ImageInput is.

    Parameters
    ----------
    node : rclpy.node.Node
    config : NodeConfig
        Names the source, and the rear lens' if there is one; ConfigError where that is none, or
        PyAV is missing.
    take : callable
        Takes each ReceivedImage, in the order of presentation.
    diagnostics : Diagnostics
        Told of what cannot be used.

    """

    def __init__(self, node: Node, config: NodeConfig, take: Callable[[ReceivedImage], None],
                 diagnostics: Diagnostics) -> None:
        self._frame_id = config.source_frame
        self._take = take
        self._diagnostics = diagnostics
        if not config.source:
            raise ConfigError('source_rear is of the other lens than source: name that, too')
        try:
            address = source_address(config.source, config.source_options)
            rear = (source_address(config.source_rear, config.source_options)
                    if config.source_rear else None)
            self._source = source_of(address, rear, self._on_picture, node.get_logger(),
                                     self._refuse, config.join)
        except SourceError as error:
            raise ConfigError(str(error)) from None
        self.name = self._source.name
        self._is_joined = config.join != NOT_JOINED
        self._in_boxes = (
            boxes_say(file_of(address)) if address.kind is Kind.FILE else InBoxes())
        self._period_s, self._counted = monotonic(), 0

    @property
    def dropped(self) -> int:
        """Return how many pictures were not used, since others came too soon or lacked one."""
        return self._source.state.left_out

    def why_silent(self) -> str:
        """Return why nothing comes, '' where something does."""
        return self._source.why_silent()

    def state(self) -> dict[str, Any]:
        """Return what /diagnostics says of the source, its rate since the last call included."""
        state = self._source.state
        now_s, counted = monotonic(), state.pictures
        rate_hz = (counted - self._counted) / max(now_s - self._period_s, 1e-3)
        self._period_s, self._counted = now_s, counted
        values = {'source': self.name, 'source_status': state.status}
        if state.size_wh is not None:
            width, height = state.size_wh
            values |= {'source_codec': state.codec, 'source_size': f'{width}x{height}',
                       'source_rate_hz': f'{rate_hz:.1f}', 'source_stamps': state.clock,
                       'source_connections': str(state.connections)}
        return values

    def start(self) -> None:
        """Start to read."""
        self._source.start()

    def close(self) -> None:
        """Stop reading."""
        self._source.close()

    # In the source's thread.

    def _on_picture(self, picture: LivePicture) -> None:
        layout = refusal = None
        if not self._is_joined:
            try:
                layout = layout_of(picture.side_data, picture.source.size_wh, self._in_boxes)
            except RecordingError as error:
                refusal = ImageError('metadata', str(error))
        self._take(ReceivedImage(picture.source, picture.stamp_ns, self._frame_id,
                                 picture.received_s, layout=layout, refusal=refusal))

    def _refuse(self, error: ImageError) -> None:
        self._diagnostics.refuse(error.reason, error)
