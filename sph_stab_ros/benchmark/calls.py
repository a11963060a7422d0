# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the benchmark times: bare OpenCV calls, stages and whole pipelines, side by side."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, cycle, islice
from time import perf_counter, process_time
from typing import Any, TypeAlias

import cv2
import numpy as np

from sph_stab_ros.benchmark.references import FIVE_POINT, FivePointChain, is_there
from sph_stab_ros.config import ANCHORED, StabilizerConfig, TrackerConfig
from sph_stab_ros.evaluation.report import Figures
from sph_stab_ros.geometry.arrays import Grey, Image
from sph_stab_ros.geometry.conventions import NS_PER_S
from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.geometry.projection import Equirect, to_grey
from sph_stab_ros.geometry.warp import (
    perspective_rays, perspective_view, rotate_equirect, view_rotation)
from sph_stab_ros.images.codec import encode_jpeg, fill_image, image_from_compressed
from sph_stab_ros.images.frame import Frame
from sph_stab_ros.recording import RecordingError
from sph_stab_ros.stabilization.pipeline import Stabilizer
from sph_stab_ros.tracking.factory import FRAME_TO_FRAME_WIDTH, make_tracker, working_width
from sph_stab_ros.tracking.frame_to_frame import features
from sph_stab_ros.tracking.frame_to_frame.estimators import fit_epipolar, fit_essential, fit_moment
from sph_stab_ros.tracking.frame_to_frame.methods import METHODS
from sph_stab_ros.tracking.frame_to_frame.optical_flow import dense_pairs, dis, spherical_flow

VIEW_SIZE_WH = (960, 540)
VIEW_HFOV_RAD = np.deg2rad(90)
FRAME_PERIOD_NS = NS_PER_S // 30
# Turned about all axes, as a camera carried about is.
R_TURNED = view_rotation(*np.deg2rad((20, 12, -9)))
R_VIEW = R_TURNED * view_rotation(*np.deg2rad((-30, -10, 0)))
# The slowest calls need fewer repeats: the rest of them is left out after so long.
BUDGET_S = 5.


@dataclass(frozen=True)
class Input:
    """
    What the calls of one round get.

    ``frame`` is in colour, ``grey`` and ``previous_grey`` are of the same width, and
    ``working_grey`` is of the anchored tracker's.
    """

    frame: Frame
    grey: Grey
    previous_grey: Grey
    working_grey: Grey


# What is timed, and with it the name of the call that it is compared with.
Call: TypeAlias = Callable[[Input], Any]
ComparedCall: TypeAlias = tuple[str, Call]
Progress: TypeAlias = Callable[[Iterable[Input]], Iterable[Input]]


def inputs(images: Sequence[Image], width: int, anchored_width: int) -> Iterator[Input]:
    """Yield an Input per consecutive pair of images; at their end they run backwards again."""
    there_and_back = cycle(chain(images, images[-2:0:-1]))
    previous_grey = None
    for number, image in enumerate(there_and_back):
        reduced = width < image.shape[1]
        image = cv2.resize(image, (width, width // 2),
                           interpolation=cv2.INTER_AREA if reduced else cv2.INTER_CUBIC)
        grey = to_grey(image, width)
        if previous_grey is not None:
            yield Input(Frame(image, number * FRAME_PERIOD_NS), grey, previous_grey,
                        to_grey(image, anchored_width))
        previous_grey = grey


def bare_calls(width: int) -> dict[str, Call]:
    """Return by name the OpenCV calls to compare with, each of an Input."""
    v, u = np.mgrid[:VIEW_SIZE_WH[1], :VIEW_SIZE_WH[0]]
    rays = perspective_rays(np.stack((u, v), axis=-1), VIEW_HFOV_RAD, *VIEW_SIZE_WH)
    sphere_map, view_map = (
        cv2.convertMaps(*Equirect(width).pixels(*np.moveaxis(
            bearings @ R.as_matrix().T, -1, 0).astype(np.float32)), cv2.CV_16SC2)
        for bearings, R in ((bearing_grid(width), R_TURNED), (rays, R_VIEW)))
    return {
        'copy': lambda given: given.frame.image.copy(),
        'cv2 flow dis': lambda given: dis(given.previous_grey, given.grey),
        'cv2 remap sphere': lambda given: cv2.remap(
            given.frame.image, *sphere_map, cv2.INTER_LINEAR),
        'cv2 remap view': lambda given: cv2.remap(
            given.frame.image, *view_map, cv2.INTER_LINEAR),
    }


def stage_calls(first: Input, width: int) -> dict[str, ComparedCall]:
    """
    Return by name the stages, each of an Input, with the bare call that it is compared with.

    The fits get flow and features of the ``first`` Input at the width they work at.
    """
    working_px = first.working_grey.shape[1]
    anchored = make_tracker(TrackerConfig(), working_px)
    fit_width = min(working_width(TrackerConfig(estimator='moment')), width)
    previous, current = (to_grey(grey, fit_width) for grey in (first.previous_grey, first.grey))
    pairs = dense_pairs(previous, current)
    matches = features.match(features.detect(previous), features.detect(current))
    start = fit_essential(matches)
    if pairs is None or start is None:
        raise RecordingError('its first two pictures show too little to estimate a rotation from')
    jpeg = encode_jpeg(first.frame.image)
    calls: dict[str, ComparedCall] = {
        'decode JPEG': ('copy', lambda given: image_from_compressed(jpeg)),
        'grey, resize': ('copy', lambda given: to_grey(given.frame.image, working_px)),
        'flow farneback': (
            'cv2 flow dis',
            lambda given: spherical_flow(given.previous_grey, given.grey, 'farneback')),
        'flow dis': (
            'cv2 flow dis', lambda given: spherical_flow(given.previous_grey, given.grey, 'dis')),
        'features A-KAZE': ('cv2 flow dis', lambda given: features.detect(given.grey)),
        'fit essential': ('copy', lambda given: fit_essential(matches)),
        'fit moment': ('copy', lambda given: fit_moment(pairs)),
        'fit epipolar': ('copy', lambda given: fit_epipolar(pairs, start)),
        'track anchored': (
            'cv2 flow dis',
            lambda given: anchored.track(given.working_grey, given.frame.stamp_ns)),
        'warp sphere': (
            'cv2 remap sphere', lambda given: rotate_equirect(given.frame.image, R_TURNED)),
        'warp view': (
            'cv2 remap view',
            lambda given: perspective_view(
                given.frame.image, R_VIEW, VIEW_HFOV_RAD, VIEW_SIZE_WH)),
        'encode JPEG': ('copy', lambda given: encode_jpeg(given.frame.image)),
    }
    try:
        from sensor_msgs.msg import Image
        calls['fill message'] = ('copy', lambda given: fill_image(Image(), given.frame.image))
    except ImportError:
        pass
    return calls


def pipeline_calls() -> dict[str, ComparedCall]:
    """Return by name whole pipelines, each of an Input, with the call that it is compared with."""
    calls: dict[str, ComparedCall] = {}
    for estimator in (ANCHORED, *METHODS):
        for pictures in ('', ' + pictures'):
            stabilizer = Stabilizer(StabilizerConfig(TrackerConfig(estimator=estimator)))
            calls[estimator + pictures] = (
                'cv2 remap sphere' if estimator == ANCHORED else ANCHORED + pictures,
                partial(stabilized, stabilizer, bool(pictures)))
    if is_there('poselib'):
        five_point = FivePointChain()
        calls[FIVE_POINT] = (ANCHORED, lambda given: five_point.track(
            to_grey(given.frame.image, FRAME_TO_FRAME_WIDTH)))
    return calls


def stabilized(stabilizer: Stabilizer, pictures: bool, given: Input) -> Any:
    """Return what a user gets: the orientation and, with ``pictures``, the sphere and a view."""
    found = stabilizer.process(given.frame)
    if not pictures:
        return found.R_world_camera
    return (found.R_world_camera, found.sphere(),
            found.view(R_VIEW, VIEW_HFOV_RAD, VIEW_SIZE_WH))


def medians(calls: Mapping[str, Call], rounds: Iterable[Input],
            progress: Progress = iter) -> dict[str, Figures]:
    """
    Return by name the median milliseconds of calls, ``{wall_ms, cpu_ms, repeats}``.

    Each of the ``rounds`` is an Input that every call gets in turn; the first warms up. CPU time
    is that of all threads: more than wall time where OpenCV uses several cores.
    """
    samples: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    spent_s = dict.fromkeys(calls, 0.)
    for given in progress(rounds):
        for name, call in calls.items():
            if spent_s[name] > BUDGET_S:
                continue
            wall_s, cpu_s = perf_counter(), process_time()
            # Kept until both clocks are read: giving back the memory is the caller's business.
            result = call(given)
            samples[name].append((perf_counter() - wall_s, process_time() - cpu_s))
            del result
            spent_s[name] += samples[name][-1][0]
    figures = {}
    for name, taken in samples.items():
        warm = taken[1:] or taken
        wall_ms, cpu_ms = (1000 * float(median) for median in np.median(warm, axis=0))
        figures[name] = {'wall_ms': wall_ms, 'cpu_ms': cpu_ms, 'repeats': len(warm)}
    return figures


def benchmark_width(images: Sequence[Image], width: int, repeats: int,
                    progress: Progress = iter) -> dict[str, dict[str, Figures]]:
    """Return the figures of one width by group: ``bare``, ``stages`` and ``pipelines``."""
    anchored_width = min(working_width(TrackerConfig()), width)
    rounds = inputs(images, width, anchored_width)
    first = next(rounds)
    groups = {'stages': stage_calls(first, width), 'pipelines': pipeline_calls()}
    calls = bare_calls(width)
    bare_names = tuple(calls)
    for group in groups.values():
        calls |= {name: call for name, (_, call) in group.items()}
    taken = medians(calls, islice(chain((first,), rounds), repeats + 1), progress)
    figures = {'bare': {name: taken[name] for name in bare_names}}
    for title, members in groups.items():
        figures[title] = {
            name: taken[name] | compared(taken[name], base, taken[base])
            for name, (base, _) in members.items()}
    return figures


def compared(figures: Figures, base: str, base_figures: Figures) -> Figures:
    """Return the name of the base, and how many times its wall and CPU time was taken."""
    return {'base': base, 'ratio': figures['wall_ms'] / base_figures['wall_ms'],
            'cpu_ratio': figures['cpu_ms'] / base_figures['cpu_ms']}
