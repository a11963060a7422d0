# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the tracker knows of its surroundings: keyframes, and the landmarks seen from them."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import (
    Bearings, Choice, Covariance, Grey, Indices, Mask, Matrix, Pixels, Vector, Vectors)
from sph_stab_ros.geometry.equirect import bearings_from_pixels, pixels_from_bearings
from sph_stab_ros.geometry.rotations import rotate_covariance
from sph_stab_ros.images.codec import encode_jpeg
from sph_stab_ros.tracking.anchored.bundle_adjustment import adjust, Window
from sph_stab_ros.tracking.anchored.landmarks import Landmarks, Observations
from sph_stab_ros.tracking.anchored.lens_misalignment import apart, lens_equations, Lenses
from sph_stab_ros.tracking.anchored.patches import (
    MAX_LATITUDE_RAD, Patches, PatchStore, Pyramid)
from sph_stab_ros.tracking.anchored.thumbnail import Thumbnail
from sph_stab_ros.tracking.frame_to_frame.features import detect, Features

MAX_LANDMARKS = 600
MIN_DISTANCE_PX = 7
MIN_CORNER_QUALITY = 2e-3
MIN_CONTRAST = 4.0
# The unit of length is such that new landmarks are at distance 1 in the beginning; their inverse
# depth is known by this much.
FIRST_INFORMATION = 0.3
MAX_INFORMATION = 1e5
# Errors of observations are alike from keyframe to keyframe: what they tell about depths counts
# half.
TRUSTED_INFORMATION = 0.5
# Adjusted are the last keyframes; fixed, those others that saw most of the same landmarks. With
# fewer a narrow view drifts twice as fast.
ADJUSTED_KEYFRAMES = 20
FIXED_KEYFRAMES = 10
MAX_KEYFRAMES, RECENT_KEYFRAMES = 48, 6
# A landmark whose observations are trusted less than this on average is none.
MIN_TRUST = 0.15
# When the lenses are known better by so much, all keyframes are adjusted anew.
LENSES_CHANGED_RAD = np.deg2rad(0.03)
# The window's covariance takes observations for independent. Calibrated on simulated flights.
COVARIANCE_INFLATION = 6.0


@dataclass
class Keyframe:
    """
    R_world_camera (3, 3), position (3,), covariance (3, 3) of the former, what was seen.

    ``jpeg`` is the camera's grey sphere, as a file: a fifth of the memory at most.
    """

    number: int
    R: Matrix
    position: Vector
    covariance: Covariance
    jpeg: NDArray[np.uint8]
    thumbnail: Thumbnail
    observations: Observations
    _features: Features | None = None

    @property
    def grey(self) -> Grey:
        """Return the camera's sphere (H, W) uint8."""
        return cv2.imdecode(self.jpeg, cv2.IMREAD_GRAYSCALE)

    def features(self, used: Mask) -> Features:
        """Return the A-KAZE Features in the pixels ``used``; found once, in some 50 ms."""
        if self._features is None:
            self._features = detect(self.grey, used)
        return self._features


@dataclass
class LandmarkMap:
    """Keyframes, oldest first, and landmarks; both are few, however long the recording is."""

    keyframes: list[Keyframe] = field(default_factory=list)
    landmarks: Landmarks | None = None
    store: PatchStore = field(default_factory=PatchStore)
    lenses: Lenses = field(default_factory=Lenses)
    _adjusted_apart: Vector = field(default_factory=lambda: np.zeros(3))
    _next_keyframe: int = 0
    _next_landmark: int = 0
    _known_poses: tuple[Indices, Matrix, Vectors] | None = None

    def hosts(self, rows: Indices) -> tuple[Matrix, Vectors]:
        """Return R (N, 3, 3) and positions (N, 3) of the hosts of the landmarks in rows."""
        assert self.landmarks is not None
        numbers, R, positions = self._poses()
        index = np.searchsorted(numbers, self.landmarks.host[rows])
        return R[index], positions[index]

    def _poses(self) -> tuple[Indices, Matrix, Vectors]:
        """Return the numbers (K,) of the keyframes, R (K, 3, 3) and positions (K, 3)."""
        # Asked for several times per frame, they seldom change.
        if self._known_poses is None:
            self._known_poses = (np.array([one.number for one in self.keyframes]),
                                 np.array([one.R for one in self.keyframes]),
                                 np.array([one.position for one in self.keyframes]))
        return self._known_poses

    def rays(self, rows: Indices, position: Vector) -> Vectors:
        """
        Return vectors (N, 3) in the world to the landmarks in rows from a position.

        Each in units of the landmark's distance from its host.
        """
        assert self.landmarks is not None
        R, origins = self.hosts(rows)
        return (np.einsum('nij,nj->ni', R, self.landmarks.x[rows])
                - self.landmarks.inverse_depth[rows, None] * (position - origins))

    def directions(self, rows: Indices, position: Vector) -> Bearings:
        """Return unit vectors (N, 3) in the world to the landmarks in rows from a position."""
        z = self.rays(rows, position)
        return z / np.linalg.norm(z, axis=1, keepdims=True)

    def add_keyframe(self, R_world_camera: Rotation, position: Vector, covariance: Covariance,
                     grey: Grey, thumbnail: Thumbnail, observations: Observations) -> None:
        """Add a Keyframe of a grey sphere (H, W), from which Observations were made."""
        self.keyframes.append(Keyframe(self._next_keyframe, R_world_camera.as_matrix(), position,
                                       covariance, encode_jpeg(grey), thumbnail, observations))
        self._next_keyframe += 1
        self._known_poses = None

    def turn(self, R_new_old: Rotation, added_variance: float) -> None:
        """Turn the whole map; what is known of orientations changes by a variance in rad²."""
        R = R_new_old.as_matrix()
        for one in self.keyframes:
            one.R, one.position = R @ one.R, R @ one.position
            one.covariance = (rotate_covariance(one.covariance, R_new_old)
                              + added_variance * np.eye(3))
        self._known_poses = None

    def add_landmarks(self, grey: Grey, pyramid: Pyramid, usable: Mask) -> None:
        """
        Add landmarks at corners of the last keyframe's picture, where there are none yet.

        ``usable`` (h, w) bool tells, in any resolution, where landmarks may be.
        """
        keyframe = self.keyframes[-1]
        width = pyramid.width
        free = cv2.resize(
            usable.astype(np.uint8), grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
        edge = round(width * (0.25 - MAX_LATITUDE_RAD / (2 * np.pi))) + MIN_DISTANCE_PX
        free[:edge] = free[-edge:] = 0
        wanted, inverse_depth = MAX_LANDMARKS, 1.
        if self.landmarks is not None:
            active = np.flatnonzero(self.landmarks.active)
            wanted -= len(active)
            if len(active):
                inverse_depth = max(float(np.median(self.landmarks.inverse_depth[active])), 1e-3)
            there = self.lenses.as_seen(
                self.directions(active, keyframe.position) @ keyframe.R)
            free[near_pixels(pixels_from_bearings(there, width), width, MIN_DISTANCE_PX)] = 0
        uv = None if wanted <= 0 else cv2.goodFeaturesToTrack(
            cv2.GaussianBlur(grey, (0, 0), 0.8), wanted, MIN_CORNER_QUALITY, MIN_DISTANCE_PX,
            mask=free, blockSize=7)
        if uv is None:
            return
        x = bearings_from_pixels(uv[:, 0].astype(float), width)
        east = np.cross((0., 1., 0.), x)
        east /= np.linalg.norm(east, axis=1, keepdims=True)
        south = np.cross(x, east)
        patches = Patches.cut(pyramid, x, east, south)
        good = patches.deviations[:, 0] > MIN_CONTRAST
        n = good.sum()
        new = Landmarks(
            self._next_landmark + np.arange(n), np.full(n, keyframe.number),
            self.lenses.corrected(x[good]), east[good],
            south[good], np.full(n, inverse_depth),
            np.full(n, FIRST_INFORMATION / inverse_depth ** 2), np.zeros(n, int),
            np.zeros(n, int), np.ones(n, bool), self.store.put(patches[good]))
        self._next_landmark += n
        self.landmarks = (new if self.landmarks is None
                          else Landmarks.joined((self.landmarks, new)))

    def adjust(self) -> None:
        """Adjust the last keyframes and what they saw; give up what does not fit."""
        assert self.landmarks is not None
        first = max(len(self.keyframes) - ADJUSTED_KEYFRAMES, 1)
        if np.linalg.norm(self.lenses.apart - self._adjusted_apart) > LENSES_CHANGED_RAD:
            # What was adjusted before was adjusted to other bearings.
            first, self._adjusted_apart = 1, self.lenses.apart
        seen_lately = np.concatenate([one.observations.number for one in self.keyframes[first:]])
        numbers = np.intersect1d(seen_lately, self.landmarks.number)
        if not len(numbers):
            return
        rows = np.searchsorted(self.landmarks.number, numbers)
        shared = [_are_among(one.observations.number, numbers) for one in self.keyframes]
        witnesses = np.argsort([-one.sum() for one in shared[:first]], kind='stable')
        used = [*sorted(witnesses[:FIXED_KEYFRAMES]), *range(first, len(self.keyframes))]
        seen = Observations.joined([self.keyframes[i].observations[shared[i]] for i in used])
        keyframe = np.repeat(used, [shared[i].sum() for i in used])
        point = np.searchsorted(numbers, seen.number)
        keyframe_numbers, R, positions = self._poses()
        host = np.searchsorted(keyframe_numbers, self.landmarks.host[rows])
        window = Window(
            R, positions, np.arange(len(self.keyframes)) >= first, host, self.landmarks.x[rows],
            self.landmarks.inverse_depth[rows], np.full(len(rows), 0.1 * FIRST_INFORMATION),
            keyframe, point, seen.y, seen.sqrt_information)
        adjusted = adjust(window, keep_distance=first == 1)
        self._known_poses = None
        base = self.keyframes[first - 1].covariance
        for i, one in enumerate(self.keyframes[first:]):
            one.R, one.position = adjusted.R[first + i], adjusted.p[first + i]
            block = slice(6 * i, 6 * i + 3)
            one.covariance = base + COVARIANCE_INFLATION * adjusted.covariance[block, block]
        self.landmarks.inverse_depth[rows] = adjusted.inverse_depths
        self.landmarks.information[rows] = np.minimum(
            TRUSTED_INFORMATION * adjusted.information, MAX_INFORMATION)
        count = np.bincount(point, minlength=len(rows))
        trust = np.bincount(point, adjusted.weights, len(rows)) / np.maximum(count, 1)
        self._keep(~np.isin(self.landmarks.number, numbers[(trust < MIN_TRUST) & (count > 1)]))
        self._take_lenses_apart(self.lenses.learn(*lens_equations(window, adjusted)))

    def _take_lenses_apart(self, rotvec: Vector) -> None:
        """Correct all bearings known so far by a further rotation vector between the lenses."""
        assert self.landmarks is not None
        self.landmarks.x = apart(self.landmarks.x, rotvec)
        for one in self.keyframes:
            one.observations.y = apart(one.observations.y, rotvec)

    def shrink(self) -> None:
        """Drop one keyframe where there are too many, with the landmarks that it hosts."""
        assert self.landmarks is not None
        if len(self.keyframes) <= MAX_KEYFRAMES:
            return
        # The world's and the newest stay. Of the others one goes that has another one near.
        old = self.keyframes[1:-RECENT_KEYFRAMES]
        positions = np.array([one.position for one in old])
        distance = np.linalg.norm(positions[:, None] - positions, axis=2)
        distance[np.diag_indices_from(distance)] = np.inf
        dropped = old[int(np.argmin(distance.min(axis=1)))]
        self.keyframes.remove(dropped)
        self._known_poses = None
        self._keep(self.landmarks.host != dropped.number)

    def near(self, position: Vector, count: int) -> Indices:
        """Return rows of up to ``count`` inactive landmarks whose hosts are nearest, ascending."""
        assert self.landmarks is not None
        inactive = np.flatnonzero(~self.landmarks.active)
        _, origins = self.hosts(inactive)
        distance = np.linalg.norm(origins - position, axis=1)
        return np.sort(inactive[np.argsort(distance, kind='stable')[:count]])

    def _keep(self, kept: Choice) -> None:
        assert self.landmarks is not None
        self.store.give_back(self.landmarks.patch[~kept])
        self.landmarks = self.landmarks[kept]


def near_pixels(uv: Pixels, width: int, distance_px: int) -> Mask:
    """Return the pixels (width / 2, width) bool about so near to pixels uv (N, 2), seam or not."""
    near = np.zeros((width // 2, width), np.uint8)
    u, v = np.rint(uv).astype(int).T
    near[np.clip(v, 0, width // 2 - 1), u % width] = 1
    near = cv2.copyMakeBorder(near, 0, 0, distance_px, distance_px, cv2.BORDER_WRAP)
    # Squares as large as circles, in a thirtieth of the time.
    side = 2 * round(distance_px * np.sqrt(np.pi) / 2) + 1
    return cv2.dilate(near, np.ones((side, side), np.uint8))[:, distance_px:-distance_px] > 0


def _are_among(numbers: Indices, others: Indices) -> Choice:
    """Tell which of ascending numbers (N,) are among ascending others (M,), M > 0."""
    place = np.minimum(np.searchsorted(others, numbers), len(others) - 1)
    return others[place] == numbers
