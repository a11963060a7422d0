#!/usr/bin/env python3
# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Draw the landmarks that the anchored tracker sees in one frame of a recording, by group.

    tools/draw_landmarks.py results/company/pioneer_0 60 landmarks.jpg
"""

import argparse
from itertools import islice
from pathlib import Path
import sys

import cv2
import numpy as np

from sph_stab_ros.command_line import run
from sph_stab_ros.geometry.equirect import pixels_from_bearings
from sph_stab_ros.recording import open_recording, RecordingError
from sph_stab_ros.stabilization.pipeline import Stabilizer

# What a landmark is, and in which colour (BGR) it is drawn.
GROUPS = {
    'agrees, and has a say': (80, 220, 60),
    'agrees, on probation': (240, 200, 40),
    'goes its own way': (60, 60, 255),
    'looked for, not found': (170, 170, 170),
}
LINE_PX = 22


def landmarks(tracker):
    """Return bearings (N, 3) in the picture, and the number of the group (N,) of each."""
    known, seen = tracker.landmark_map, tracker.localization
    missed = np.setdiff1d(np.flatnonzero(known.landmarks.active), seen.rows)
    directions = known.directions(missed, seen.pose.position)
    group = np.where(seen.agreeing, np.where(known.is_mature(seen.rows), 0, 1), 2)
    return (known.lenses.as_seen(np.concatenate(
        (seen.points.y, seen.R_world_camera.inv().apply(directions)))),
        np.concatenate((group, np.full(len(missed), 3))))


def draw(image, bearings, group):
    """Return the picture (H, W, 3) with landmarks on it and a legend below."""
    height, width = image.shape[:2]
    picture = cv2.copyMakeBorder(image, 0, LINE_PX, 0, 0, cv2.BORDER_CONSTANT)
    # Those who go their own way on top of those who are not seen, the world's below them.
    for number in (3, 0, 1, 2):
        colour = list(GROUPS.values())[number]
        for centre in np.rint(pixels_from_bearings(bearings[group == number], width)).astype(int):
            cv2.circle(picture, centre.tolist(), 4, (0, 0, 0), -1, cv2.LINE_AA)
            cv2.circle(picture, centre.tolist(), 3, colour, -1, cv2.LINE_AA)
    for number, (name, colour) in enumerate(GROUPS.items()):
        left, middle = 10 + number * width // len(GROUPS), height + LINE_PX // 2
        cv2.circle(picture, (left, middle), 4, colour, -1, cv2.LINE_AA)
        cv2.putText(picture, f'{name}: {(group == number).sum()}', (left + 10, middle + 4),
                    cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


def main():
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('recording', type=Path, metavar='RECORDING')
    parser.add_argument('frame', type=int, metavar='N', help='which frame, from 0')
    parser.add_argument('output', type=Path, metavar='OUT', help='a picture to write')
    args = parser.parse_args()
    if not cv2.haveImageWriter(str(args.output)):
        parser.error(f"'{args.output}' is no name of a picture")

    def command():
        stabilizer = Stabilizer()
        for frame in islice(open_recording(args.recording).frames(), args.frame + 1):
            stabilizer.process(frame)
        if stabilizer.tracker is None or stabilizer.tracker.localization is None:
            raise RecordingError(f'{args.recording.name}: frame {args.frame} is not localized')
        cv2.imwrite(str(args.output), draw(frame.image, *landmarks(stabilizer.tracker)))

    return run('draw_landmarks', command)


if __name__ == '__main__':
    sys.exit(main())
