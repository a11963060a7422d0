# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Whether a picture shows enough to measure motion by."""

import cv2
import numpy as np

from sph_stab_ros.geometry.arrays import Grey

# Flow interpolates where nothing is to be seen; a picture without contrast has no flow at all.
TEXTURE_WIDTH = 160
MIN_CONTRAST = 2.0
MIN_TEXTURED_FRACTION = 0.02


def at_most(grey: Grey, width: int) -> Grey:
    """Return a grey sphere, reduced where it is wider than this."""
    if grey.shape[1] <= width:
        return grey
    return cv2.resize(grey, (width, width // 2), interpolation=cv2.INTER_AREA)


def has_texture(grey: Grey) -> bool:
    """Tell whether a grey sphere shows enough to measure any motion by."""
    grey = at_most(grey, TEXTURE_WIDTH)
    fine, coarse = (cv2.GaussianBlur(grey, (0, 0), sigma_px) for sigma_px in (0.7, 2.7))
    return bool(np.mean(cv2.absdiff(fine, coarse) > MIN_CONTRAST) > MIN_TEXTURED_FRACTION)
