# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Corners of a picture, where patches can be cut."""

import cv2
import numpy as np
from sph_stab_ros.geometry.equirect import bearings_from_pixels
from synthetic import unit

MAX_LATITUDE_DEG = 60


def corners(image, count=150):
    """Return bearings x (N, 3) of corners up to 60° of latitude, and tangents east, south."""
    width = image.shape[1]
    free = np.zeros(image.shape, np.uint8)
    edge = round(width * (90 - MAX_LATITUDE_DEG) / 360)
    free[edge:-edge] = 1
    uv = cv2.goodFeaturesToTrack(np.uint8(image), count, 0.05, 6, mask=free, blockSize=7)[:, 0]
    x = bearings_from_pixels(np.float64(uv), width)
    east = unit(np.cross((0., 1., 0.), x))
    return x, east, np.cross(x, east)
