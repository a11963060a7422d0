# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where the patches of all landmarks are kept."""

from dataclasses import fields

import numpy as np

from sph_stab_ros.geometry.arrays import Indices
from sph_stab_ros.tracking.anchored.patches import Patches


class PatchStore:
    """Patches that stay where they are: thousands of them take milliseconds to be moved."""

    def __init__(self) -> None:
        self.patches: Patches | None = None
        self._free: Indices = np.empty(0, int)

    def put(self, patches: Patches) -> Indices:
        """Take in Patches and return the rows (N,) in which they are."""
        missing = len(patches) - len(self._free)
        if missing > 0:
            size = 0 if self.patches is None else len(self.patches)
            more = max(missing, size // 2)
            room = patches[np.zeros(more, int)]
            self.patches = room if self.patches is None else Patches.joined((self.patches, room))
            self._free = np.concatenate((self._free, np.arange(size, size + more)))
        rows, self._free = np.split(self._free, [len(patches)])
        for one in fields(Patches) if len(patches) else ():
            getattr(self.patches, one.name)[rows] = getattr(patches, one.name)
        return rows

    def give_back(self, rows: Indices) -> None:
        """Let others use these rows (N,) from now on."""
        self._free = np.concatenate((self._free, rows))
