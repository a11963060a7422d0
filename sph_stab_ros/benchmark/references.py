# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Other methods on the same pictures: how exact they are, and how long they take.

Two references, each where its library is installed: the chain of A-KAZE matches and PoseLib's
five-point solver, and COLMAP's structure-from-motion of equirectangular pictures, offline.
"""

from collections.abc import Callable, Iterable, Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import ANCHORED, StabilizerConfig, TrackerConfig
from sph_stab_ros.evaluation.ground_truth import find_truth_topic, read_truth
from sph_stab_ros.evaluation.orientation_errors import compare
from sph_stab_ros.evaluation.report import Figures
from sph_stab_ros.evaluation.runs import evaluate_against_truth, increasing
from sph_stab_ros.geometry.arrays import (
    Bearings, Choice, Floats, Grey, Image, Indices, Matrix, Vector)
from sph_stab_ros.geometry.projection import to_grey
from sph_stab_ros.geometry.warp import view_rotation
from sph_stab_ros.recording import decoded_frames, Recording, RecordingError
from sph_stab_ros.tracking.factory import FRAME_TO_FRAME_WIDTH
from sph_stab_ros.tracking.frame_to_frame.estimators import BearingPairs
from sph_stab_ros.tracking.frame_to_frame.estimators.essential import (
    decompose, epipolar_distance, INLIER_RAD, MIN_INLIERS)
from sph_stab_ros.tracking.frame_to_frame.features import detect, Features, match

FIVE_POINT = 'A-KAZE + PoseLib'
STRUCTURE = 'COLMAP'
STRUCTURE_FRAMES = 100

BATCH = 64
MAX_SAMPLES = 1024
CONFIDENCE = 0.999
# Of PoseLib's refinement, in pixels of faces with a focal length of one: radians, about.
LOSS = {'loss_type': 'CAUCHY', 'loss_scale': INLIER_RAD / 2}
FACE = {'model': 'SIMPLE_PINHOLE', 'width': 2, 'height': 2, 'params': [1., 0., 0.]}
# The six faces of a cube, R_face_camera.
FACES = np.stack([view_rotation(yaw_rad, pitch_rad).inv().as_matrix() for yaw_rad, pitch_rad in (
    *((quarter * np.pi / 2, 0) for quarter in range(4)), (0, np.pi / 2), (0, -np.pi / 2))])


def is_there(module: str) -> bool:
    """Tell whether an optional module is installed."""
    return find_spec(module) is not None


class FivePointChain:
    """
    A chain of rotations from A-KAZE matches by PoseLib's five-point solver.

    PoseLib's own RANSAC takes pinhole cameras only, half of the sphere at most; that for several
    cameras degenerates where all have the same centre. Its minimal solver takes bearings, and its
    refinement takes the faces of a cube: between these two the samples are drawn and counted here.
    """

    def __init__(self, seed: int = 0) -> None:
        self._rng = np.random.default_rng(seed)
        self._features: Features | None = None
        self._R_world_camera = Rotation.identity()
        self.lost = 0

    def track(self, grey: Grey) -> Rotation:
        """Return R_world_camera of the next grey sphere; held where it is lost."""
        features = detect(grey)
        if self._features is not None:
            R = relative_rotation(match(self._features, features), self._rng)
            self.lost += R is None
            self._R_world_camera *= Rotation.identity() if R is None else R.inv()
        self._features = features
        return self._R_world_camera


def relative_rotation(pairs: BearingPairs, rng: np.random.Generator) -> Rotation | None:
    """Return R_current_previous of BearingPairs with outliers, None where too few agree."""
    if len(pairs) < MIN_INLIERS:
        return None
    E, inliers = _ransac(pairs, rng)
    if E is None or inliers.sum() < MIN_INLIERS:
        return None
    return _refined(pairs[inliers], *decompose(E, pairs[inliers]))


def _ransac(pairs: BearingPairs, rng: np.random.Generator) -> tuple[Matrix | None, Choice]:
    """Return the essential matrix of the best of many samples of five, and its inliers (N,)."""
    import poselib
    best_E: Matrix | None = None
    best: Choice = np.zeros(len(pairs), bool)
    samples_needed, samples = MAX_SAMPLES, 0
    while samples < samples_needed:
        chosen = rng.random((BATCH, len(pairs))).argpartition(5, axis=1)[:, :5]
        poses = [pose for five in chosen
                 for pose in poselib.relpose_5pt(pairs.previous[five], pairs.current[five])]
        samples += BATCH
        if not poses:
            continue
        E = np.array([np.cross(pose.t, pose.R, axisb=0, axisc=0) for pose in poses])
        inliers = epipolar_distance(E, pairs) < INLIER_RAD
        counts = inliers.sum(axis=1)
        if counts.max() > best.sum():
            best_E, best = E[counts.argmax()], inliers[counts.argmax()]
            all_inliers = min(best.mean() ** 5, 1 - 1e-9)
            samples_needed = min(MAX_SAMPLES, np.log(1 - CONFIDENCE) / np.log1p(-all_inliers))
    return best_E, best


def _refined(pairs: BearingPairs, R_current_previous: Rotation, t_current: Vector) -> Rotation:
    """Return R_current_previous after PoseLib's refinement on the faces of a cube."""
    import poselib

    def pose(R: Matrix, t: Vector) -> Any:
        made = poselib.CameraPose()
        made.R, made.t = R, t
        return made

    (face, x), (face_current, x_current) = map(
        _on_faces, (pairs.previous, pairs.current))
    matches = []
    for both in np.unique(np.column_stack((face, face_current)), axis=0):
        members = (face == both[0]) & (face_current == both[1])
        matched = poselib.PairwiseMatches()
        matched.cam_id1, matched.cam_id2 = both.tolist()
        matched.x1, matched.x2 = x[members], x_current[members]
        matches.append(matched)
    faces = [pose(R_face_camera, np.zeros(3)) for R_face_camera in FACES]
    cameras = [FACE] * len(FACES)
    refined, _ = poselib.refine_generalized_relative_pose(
        matches, pose(R_current_previous.as_matrix(), t_current), faces, cameras, faces, cameras,
        LOSS)
    return Rotation.from_matrix(refined.R)


def _on_faces(bearings: Bearings) -> tuple[Indices, Floats]:
    """Return for bearings (N, 3) the face (N,) that shows each, and where in it (N, 2)."""
    in_faces = np.einsum('fij,nj->nfi', FACES, bearings)
    face = in_faces[..., 2].argmax(axis=1)
    seen = in_faces[np.arange(len(face)), face]
    return face, seen[:, :2] / seen[:, 2:]


def structure_from_motion(images: Iterable[Image]) -> tuple[Indices, Rotation]:
    """
    Return which of the images (H, W, 3) COLMAP has placed (N,), and their R_world_camera.

    Incremental, each picture matched with the ten before it and with some further back. Without
    movement, hence structure, it places none: RecordingError.
    """
    import pycolmap
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL
    with TemporaryDirectory() as folder:
        database, pictures, sparse = (
            Path(folder) / name for name in ('colmap.db', 'images', 'models'))
        pictures.mkdir()
        sparse.mkdir()
        for number, image in enumerate(images):
            cv2.imwrite(str(pictures / f'{number:06}.png'), image)
        pycolmap.extract_features(
            database, pictures, camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=pycolmap.ImageReaderOptions(camera_model='EQUIRECTANGULAR'))
        pycolmap.match_sequential(database)
        # An equirectangular camera has nothing to calibrate.
        models = pycolmap.incremental_mapping(
            database, pictures, sparse, pycolmap.IncrementalPipelineOptions(
                ba_refine_focal_length=False, ba_refine_extra_params=False,
                extract_colors=False, multiple_models=False, random_seed=0))
        if not models:
            raise RecordingError('COLMAP finds no structure in its pictures')
        model = max(models.values(), key=lambda model: model.num_reg_images())
        placed = sorted((int(Path(image.name).stem), image.cam_from_world().rotation.quat)
                        for image in model.images.values() if image.has_pose)
    numbers, quaternions = zip(*placed)
    return np.array(numbers), Rotation.from_quat(quaternions).inv()


def references(recording: Recording, R_body_camera: Rotation | None = None,
               progress: Callable[[str, Any], Iterable[Any]] = lambda name, frames: frames
               ) -> dict[str, Figures]:
    """
    Return by name ``{frames, lost_frames, geodesic_deg, ms_per_frame}`` against the truth.

    Beside the references stand ``anchored`` and ``pts``, over as many frames; time is that of the
    whole, pictures in memory. The mount, unless it is given, is that of the estimator that follows
    the truth best.
    RecordingError where there is no truth.
    """
    truth = read_truth(recording, find_truth_topic(recording))
    configs = {name: StabilizerConfig(TrackerConfig(estimator=name)) for name in (ANCHORED, 'pts')}
    alignment, _, figures = evaluate_against_truth(
        recording, configs, truth, R_body_camera, progress=progress)
    frames = list(decoded_frames(recording))

    def add(name: str, stamps_ns: Sequence[int], rotations: Rotation, elapsed_s: float,
            shown: int) -> None:
        errors = compare(truth, increasing(stamps_ns, rotations), alignment)
        figures[name] = errors.summary() | {
            'ms_per_frame': 1000 * elapsed_s / shown, 'lost_frames': shown - len(stamps_ns)}

    if is_there('poselib'):
        tracker, start_s = FivePointChain(), perf_counter()
        rotations = [tracker.track(to_grey(frame.image, FRAME_TO_FRAME_WIDTH))
                     for frame in progress(FIVE_POINT, frames)]
        add(FIVE_POINT, [frame.stamp_ns for frame in frames], Rotation.concatenate(rotations),
            perf_counter() - start_s, len(frames))
        figures[FIVE_POINT]['lost_frames'] = tracker.lost
    if is_there('pycolmap'):
        some = frames[:STRUCTURE_FRAMES]
        start_s = perf_counter()
        placed, R_world_placed = structure_from_motion([frame.image for frame in some])
        add(STRUCTURE, [some[number].stamp_ns for number in placed], R_world_placed,
            perf_counter() - start_s, len(some))
        _, _, short = evaluate_against_truth(
            recording, {ANCHORED: configs[ANCHORED]}, truth, alignment.R_body_camera,
            max_frames=STRUCTURE_FRAMES, progress=progress)
        figures[f'{ANCHORED}, {len(some)} frames'] = short[ANCHORED]
    return {name: {key: method[key] for key in (
        'frames', 'lost_frames', 'geodesic_deg', 'ms_per_frame')}
        for name, method in figures.items()}
