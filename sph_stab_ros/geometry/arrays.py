# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The arrays that pass between modules, named by what they hold.

A checker sees the type of their elements only; the shapes, in the comments, are for the reader.
"""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

# float32 or float64.
Floats: TypeAlias = NDArray[np.floating[Any]]

# Of a picture or anything else with a value, or several, for each pixel.
Grey: TypeAlias = NDArray[np.uint8]  # (H, W)
Bgr: TypeAlias = NDArray[np.uint8]  # (H, W, 3), blue first
Image: TypeAlias = NDArray[np.uint8]  # Bgr or Grey
Mask: TypeAlias = NDArray[np.bool_]  # (H, W), mostly of the pixels to use
Faces: TypeAlias = NDArray[np.uint8]  # (H, W), which of the parts of a picture something is on
Plane: TypeAlias = Floats  # (H, W)
Flow: TypeAlias = Floats  # (H, W, 2), how far each pixel moves, in pixels
Raster: TypeAlias = NDArray[Any]  # (H, W[, C]) of any type

# Places in a picture and directions in space.
Pixels: TypeAlias = Floats  # (..., 2) as (u, v), pixel centres being integers
Bearings: TypeAlias = Floats  # (..., 3) in the camera's frame, of unit length unless it says not
Vector: TypeAlias = Floats  # (3,)
Vectors: TypeAlias = Floats  # (N, 3)
Matrix: TypeAlias = Floats  # (3, 3), or several (..., 3, 3)
Covariance: TypeAlias = Floats  # (3, 3)

# One for each of N things.
Values: TypeAlias = Floats  # (N,)
Choice: TypeAlias = NDArray[np.bool_]  # (N,)
Indices: TypeAlias = NDArray[np.integer[Any]]  # (N,)
Stamps: TypeAlias = NDArray[np.int64]  # (N,) in nanoseconds
