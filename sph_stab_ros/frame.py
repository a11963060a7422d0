# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
"""One picture with its time, as it passes from the recordings and topics into the core."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Frame:
    """
    A spherical picture and when it was taken.

    ``image`` is (H, W, 3) uint8 in BGR order or (H, W) uint8, W = 2 H, and is not written to;
    ``stamp_ns`` is the header's or the container's time; ``frame_id`` names the camera's frame.
    """

    image: np.ndarray
    stamp_ns: int
    frame_id: str = ''
