# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A frame as the tracker takes it in: what is made of its picture once, for all who ask."""

from sph_stab_ros.geometry.arrays import Grey
from sph_stab_ros.images.texture import at_most, TEXTURE_WIDTH
from sph_stab_ros.tracking.anchored.patches import PatchOptions, Pyramid
from sph_stab_ros.tracking.anchored.thumbnail import Thumbnail, ThumbnailOptions


class PreparedFrame:
    """A grey sphere, as a whole and small, with its Pyramid and its Thumbnail."""

    def __init__(self, grey: Grey, patches: PatchOptions, thumbnails: ThumbnailOptions) -> None:
        self.grey = grey
        self.small = at_most(grey, TEXTURE_WIDTH)
        self.pyramid = Pyramid(grey, patches)
        self.thumbnail = Thumbnail(self.small, thumbnails)
