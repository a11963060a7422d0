# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The folders that ``evaluate`` writes."""

from collections.abc import Mapping
import logging
from pathlib import Path

from sph_stab_ros.evaluation.orientation_errors import Errors
from sph_stab_ros.geometry.trajectory import write_tum
from sph_stab_ros.recording import Recording, RecordingError
from sph_stab_ros.recording.partial_output import partial_output

logger = logging.getLogger(__name__)


def draw(folder: Path, recording: Recording, errors: Mapping[str, Errors]) -> None:
    """Write the figures: of the errors, and of flow on the sphere as the paper shows it."""
    from sph_stab_ros.evaluation import paper_figures, plots
    plots.draw(folder, recording.name, errors)
    most_frames = max(len(estimator_errors.time_s) for estimator_errors in errors.values())
    example = paper_figures.find_example(recording, most_frames)
    if example is None:
        logger.warning('%s: no figures of flow: no two pictures show enough parallax',
                       recording.name)
    else:
        paper_figures.draw(folder, recording.name, example)


def write_trajectories(folder: Path, errors: Mapping[str, Errors]) -> None:
    """Write what the Errors by estimator compare, one file each, for other tools to compare."""
    trajectories = {name.replace('/', '_'): estimator_errors.estimate
                    for name, estimator_errors in errors.items()}
    # The truth, at the frames' times and of the camera, is the same for all.
    trajectories['truth'] = next(iter(errors.values())).truth
    for name, trajectory in trajectories.items():
        with partial_output(folder / f'{name}.tum', force=True) as path:
            write_tum(path, trajectory)


def make_folder(folder: Path) -> None:
    """Make the folder of an output before all the work is done."""
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise RecordingError(f'{folder} cannot be written: {error.strerror}') from error
