# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Write three views of every tenth picture, which do not turn: VIDEO_OR_BAG FOLDER."""

from pathlib import Path
import sys

import cv2
import numpy as np
from sph_stab_ros import open_recording, Stabilizer, view_rotation

YAW_DEG = {'front': 0, 'left': 90, 'rear': 180}

stabilizer = Stabilizer()
for number, frame in enumerate(open_recording(sys.argv[1]).frames()):
    stabilized = stabilizer.process(frame)
    if number % 10 == 0:
        for name, yaw_deg in YAW_DEG.items():
            picture = stabilized.view(
                view_rotation(yaw_rad=np.deg2rad(yaw_deg)), hfov_rad=np.pi / 2, size_wh=(640, 480))
            cv2.imwrite(str(Path(sys.argv[2]) / f'{name}_{number:04d}.png'), picture)
