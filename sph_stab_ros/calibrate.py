# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Refine the calibration of two fisheye lenses from a recording by what both of them see.

The recording should turn about all axes, somewhere with texture all around and nothing nearer
than a metre or two. Of one that shows less it says which parameters it could not tell.
"""

# Before all that takes time to import.
if __name__ == '__main__':
    from sph_stab_ros.executable import start
    raise SystemExit(start('calibrate'))

from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from itertools import islice
from pathlib import Path

import numpy as np

from sph_stab_ros.calibration.dual_fisheye import (
    calibrate, Calibration, CalibrationError, for_size)
from sph_stab_ros.calibration.file import calibration_text
from sph_stab_ros.command_line import (
    add_recording, check_stretch, frames_to_read, one_line, open_given, Parser, run)
from sph_stab_ros.command_line.parameters import (
    add_calibration, add_parameters, given_parameters, settings_from)
from sph_stab_ros.config import FisheyeConfig, Settings
from sph_stab_ros.geometry.arrays import Grey
from sph_stab_ros.geometry.fisheye import fits
from sph_stab_ros.geometry.lens_file import with_lens_file
from sph_stab_ros.geometry.projection import to_grey
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.recording import decoded_frames, Recording, RecordingError
from sph_stab_ros.recording.partial_output import partial_output

from tqdm import tqdm

# Spread over the recording; more change little.
PICTURES = 60
# Taken where a recording does not tell how long it is.
STEP = 10


def spread_images(
        recording: Recording, config: FisheyeConfig, max_frames: int | None = None,
        progress: Callable[[Iterator[Frame]], Iterable[Frame]] = iter) -> list[Grey]:
    """
    Return grey images of one size, at most PICTURES, spread over a recording.

    Raises RecordingError where none fits the FisheyeConfig.
    """
    total = frames_to_read(recording, max_frames)
    step = -(-total // PICTURES) if total else STEP
    greys: list[Grey] = []
    sizes: set[str] = set()
    with closing(decoded_frames(recording)) as frames:
        for number, frame in enumerate(progress(islice(frames, max_frames))):
            if number % step or len(greys) == PICTURES:
                continue
            image = frame.image
            height, width = image.shape[:2]
            sizes.add(f'{width}x{height}')
            if fits(config, (width, height)) and (not greys or greys[0].shape == image.shape[:2]):
                greys.append(to_grey(image))
    if not greys:
        raise RecordingError(
            f'{recording.name} has no pictures that the calibration to start from is for, '
            f'{config.width}x{config.height} or scaled ({", ".join(sorted(sizes)) or "none"})')
    return greys


def report(
        recording: Recording, greys: Sequence[Grey], calibration: Calibration) -> Iterator[str]:
    """Yield the lines that tell of a Calibration."""
    yield (f'{recording.name}: {len(calibration.after_rad)} corners seen by both lenses in '
           f'{len(greys)} pictures')
    for when, angles_rad in (('before', calibration.before_rad), ('after', calibration.after_rad)):
        median, most = np.rad2deg(np.percentile(angles_rad, (50, 95)))
        yield f'disagreement {when}: median {median:.3f} deg, 95 % below {most:.3f} deg'
    yield f'told: {", ".join(calibration.told)}'
    yield f'not told, and near what it was: {", ".join(calibration.untold) or "nothing"}'


def arguments(argv: Sequence[str] | None) -> tuple[Namespace, Settings]:
    """Return the parsed command line and the Settings to start from; exit 2 on a usage error."""
    parser = Parser(prog='calibrate', description=__doc__)
    add_recording(parser, 'REC')
    parser.add_argument('--out', metavar='FILE.yaml', type=Path, required=True,
                        help='where to write the parameters of the node')
    parser.add_argument('--force', action='store_true', help='replace FILE.yaml')
    add_calibration(add_parameters(parser, 'The calibration to start from is fisheye.* of these'))
    args = parser.parse_args(argv)
    check_stretch(parser, args)
    return args, settings_from(parser, given_parameters(parser, args))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    args, settings = arguments(argv)
    start = with_lens_file(settings.config.fisheye, (0, 0))

    def command() -> None:
        recording = open_given(args, settings.config.join)
        with partial_output(args.out, args.force) as path:
            greys = spread_images(recording, start, args.max_frames, lambda frames: tqdm(
                frames, total=frames_to_read(recording, args.max_frames), unit=' frames',
                disable=None))
            try:
                calibration = calibrate(greys, for_size(start, greys[0].shape[::-1]))
            except CalibrationError as error:
                raise RecordingError(f'{recording.name}: {error}') from error
            lines = list(report(recording, greys, calibration))
            path.write_text(calibration_text(calibration.config, ''.join(
                f'# {line}\n' for line in ('Written by calibrate.', *map(one_line, lines)))),
                'utf-8')
        for line in lines:
            print(line)

    return run('calibrate', command)
