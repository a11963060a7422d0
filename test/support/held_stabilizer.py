# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
The node, whose estimators of the paper take as long as told: ``held_stabilizer.py FOLDER ARG…``.

An image that reaches the estimator while FOLDER/hold exists stays there, which FOLDER/held tells.
"""

from pathlib import Path
import sys
import time

from sph_stab_ros.stabilizer import main
from sph_stab_ros.tracking.frame_to_frame.tracker import FrameToFrameTracker

POLL_S = 0.01


def hold_images(folder: Path) -> None:
    """Make all FrameToFrameTrackers wait for as long as ``folder``/hold exists."""
    track = FrameToFrameTracker.track

    def track_when_let_go(tracker, grey, stamp_ns):
        while (folder / 'hold').exists():
            (folder / 'held').touch()
            time.sleep(POLL_S)
        return track(tracker, grey, stamp_ns)
    FrameToFrameTracker.track = track_when_let_go


if __name__ == '__main__':
    hold_images(Path(sys.argv[1]))
    sys.exit(main(sys.argv[:1] + sys.argv[2:]))
