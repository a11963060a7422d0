# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the tracker knows of its surroundings: keyframes, and the landmarks seen from them."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.geometry.arrays import (
    Bearings, Choice, Covariance, Grey, Indices, Mask, Matrix, Values, Vector, Vectors)
from sph_stab_ros.geometry.rotations import rotate_covariance
from sph_stab_ros.images.codec import encode_jpeg
from sph_stab_ros.tracking.anchored.bundle_adjustment import adjust, Adjusted
from sph_stab_ros.tracking.anchored.bundle_window import Window
from sph_stab_ros.tracking.anchored.corners import find_corners
from sph_stab_ros.tracking.anchored.keyframe import Keyframe
from sph_stab_ros.tracking.anchored.landmarks import are_among, Landmarks, Observations
from sph_stab_ros.tracking.anchored.lens_misalignment import apart, lens_equations, Lenses
from sph_stab_ros.tracking.anchored.map_options import MapOptions
from sph_stab_ros.tracking.anchored.patch_store import PatchStore
from sph_stab_ros.tracking.anchored.patches import Patches, Pyramid
from sph_stab_ros.tracking.anchored.readout import Readout
from sph_stab_ros.tracking.anchored.thumbnail import Thumbnail


class LandmarkMap:
    """
    Keyframes, oldest first, and landmarks; both are few, however long the recording is.

    What becomes of a landmark, from its birth on, is written by methods of this class alone.
    Keyframes and the window of the last of them, adjusted against fixed ones that share their
    landmarks, are as in R. Mur-Artal, J. M. M. Montiel and J. D. Tardós, *ORB-SLAM: a versatile
    and accurate monocular SLAM system*, IEEE Transactions on Robotics 31(5), 2015.
    """

    def __init__(self, options: MapOptions, readout: Readout | None = None) -> None:
        self.options, self.readout = options, readout or Readout()
        self.keyframes: list[Keyframe] = []
        self.lenses = Lenses(options.lenses)
        self._landmarks = Landmarks.none()
        self._store = PatchStore()
        self._adjusted_apart: Vector = np.zeros(3)
        self._next_keyframe = self._next_landmark = 0
        self._all_in_world: tuple[Bearings, Bearings, Vectors] | None = None

    @property
    def landmarks(self) -> Landmarks:
        """All landmarks as they are now, to be read."""
        return self._landmarks

    @property
    def patches(self) -> Patches:
        """Patches of the landmarks, in the rows that these tell; some, once one is born."""
        assert self._store.patches is not None
        return self._store.patches

    def in_world(self, rows: Indices) -> tuple[Bearings, Bearings, Vectors]:
        """Return x and east (N, 3) of the landmarks in rows, in the world, and whence (N, 3)."""
        x, east, origins = self._in_world()
        return x.take(rows, axis=0), east.take(rows, axis=0), origins.take(rows, axis=0)

    def _in_world(self) -> tuple[Bearings, Bearings, Vectors]:
        """Return the same of all L landmarks, (L, 3) each."""
        # Asked for several times per frame, they change with keyframes alone.
        if self._all_in_world is None:
            numbers, R, positions = self._poses()
            host = np.searchsorted(numbers, self._landmarks.host)
            self._all_in_world = (
                np.einsum('nij,nj->ni', R[host], self._landmarks.x),
                np.einsum('nij,nj->ni', R[host], self._landmarks.east), positions[host])
        return self._all_in_world

    def _poses(self) -> tuple[Indices, Matrix, Vectors]:
        """Return the numbers (K,) of the keyframes, R (K, 3, 3) and positions (K, 3)."""
        return (np.array([one.number for one in self.keyframes]),
                np.array([one.R for one in self.keyframes]),
                np.array([one.position for one in self.keyframes]))

    def rays(self, rows: Indices, position: Vector) -> Vectors:
        """
        Return vectors (N, 3) in the world to the landmarks in rows from a position.

        Each in units of the landmark's distance from its host.
        """
        x, _, origins = self._in_world()
        return x.take(rows, axis=0) - self._landmarks.inverse_depth[rows, None] * (
            position - origins.take(rows, axis=0))

    def directions(self, rows: Indices, position: Vector) -> Bearings:
        """Return unit vectors (N, 3) in the world to the landmarks in rows from a position."""
        z = self.rays(rows, position)
        return z / np.linalg.norm(z, axis=1, keepdims=True)

    def is_mature(self, rows: Indices) -> Choice:
        """Tell which of the landmarks in rows have a say in the pose."""
        return self._landmarks.agreed[rows] >= self.options.landmarks.mature_frames

    def near(self, position: Vector, count: int) -> Indices:
        """Return rows of up to ``count`` inactive landmarks whose hosts are nearest, ascending."""
        inactive = np.flatnonzero(~self._landmarks.active)
        _, _, origins = self._in_world()
        distance = np.linalg.norm(origins[inactive] - position, axis=1)
        return np.sort(inactive[np.argsort(distance, kind='stable')[:count]])

    def add_keyframe(self, R_world_camera: Rotation, position: Vector, covariance: Covariance,
                     grey: Grey, thumbnail: Thumbnail, observations: Observations) -> None:
        """Add a Keyframe of a grey sphere (H, W), from which Observations were made."""
        self.keyframes.append(Keyframe(self._next_keyframe, R_world_camera.as_matrix(), position,
                                       covariance, encode_jpeg(grey), thumbnail, observations))
        self._next_keyframe += 1

    def lens_covariance(self, R_world_camera: Rotation) -> Covariance:
        """Return how uncertain an orientation is because of the lenses: (3, 3) in rad²."""
        # By matrices: SciPy takes ten times as long, and this is asked of every frame.
        return self.lenses.covariance(self.keyframes[0].R.T @ R_world_camera.as_matrix())

    def turn(self, R_new_old: Rotation, added_variance: float) -> None:
        """Turn the whole map; what is known of orientations changes by a variance in rad²."""
        R = R_new_old.as_matrix()
        for one in self.keyframes:
            one.R, one.position = R @ one.R, R @ one.position
            one.covariance = (rotate_covariance(one.covariance, R_new_old)
                              + added_variance * np.eye(3))
        self._all_in_world = None

    def shrink(self) -> None:
        """Drop one keyframe where there are too many, with the landmarks that it hosts."""
        if len(self.keyframes) <= self.options.max_keyframes:
            return
        # The world's and the newest stay. Of the others one goes that has another one near.
        old = self.keyframes[1:-self.options.recent_keyframes]
        positions = np.array([one.position for one in old])
        distance = np.linalg.norm(positions[:, None] - positions, axis=2)
        distance[np.diag_indices_from(distance)] = np.inf
        dropped = old[int(np.argmin(distance.min(axis=1)))]
        self.keyframes.remove(dropped)
        self._forget(self._landmarks.host == dropped.number)

    def add_landmarks(self, grey: Grey, pyramid: Pyramid, free: Mask) -> None:
        """
        Add landmarks at corners of the last keyframe's picture, where there are none yet.

        ``free`` (h, w) bool tells, in any resolution, where landmarks may be.
        """
        keyframe, options = self.keyframes[-1], self.options
        active = np.flatnonzero(self._landmarks.active)
        there = self.lenses.as_seen(self.readout.as_seen(
            self.directions(active, keyframe.position) @ keyframe.R,
            self._landmarks.inverse_depth[active]))
        x = find_corners(grey, free, there, options.max_landmarks - len(active),
                         options.patches.max_latitude_rad, options.corners)
        if not len(x):
            return
        east = np.cross((0., 1., 0.), x)
        east /= np.linalg.norm(east, axis=1, keepdims=True)
        south = np.cross(x, east)
        patches = Patches.cut(pyramid, x, east, south)
        good = patches.deviations[:, 0] > options.min_contrast
        # As far away as the others.
        inverse_depth = max(float(np.median(self._landmarks.inverse_depth[active])),
                            1e-3) if len(active) else 1.
        self.add(Landmarks.new(
            self._next_landmark, keyframe.number,
            (self.readout.corrected(self.lenses.corrected(x[good]), inverse_depth), east[good],
             south[good]), inverse_depth,
            options.first_information / inverse_depth ** 2, self._store.put(patches[good])))

    def add(self, landmarks: Landmarks) -> None:
        """Add Landmarks that are born, numbered on from those before."""
        self._landmarks = Landmarks.joined((self._landmarks, landmarks))
        self._all_in_world = None
        self._next_landmark += len(landmarks)

    def correct_first(self) -> None:
        """Correct what the only keyframe shows by its read-out, once it is known how it moved."""
        self._move_bearings(
            self.readout.corrected(self._landmarks.x, self._landmarks.inverse_depth))

    def judge(self, rows: Indices, agreeing: Choice, inverse_depths: Values,
              for_good: bool = True) -> None:
        """
        Take in how the landmarks in rows were seen; deactivate those that are long missed.

        Those ``agreeing`` (N,) bool were where the pose says, with its inverse depths (N,). Unless
        it is ``for_good`` the pose may turn out wrong: then all that were seen stay.
        """
        judged = self._landmarks.judged if for_good else self._landmarks.judged_for_now
        self._landmarks = judged(rows, agreeing, inverse_depths, self.options.landmarks)

    def wake(self, rows: Indices) -> None:
        """Look for the landmarks in rows again, which have just been seen."""
        self._landmarks = self._landmarks.woken(rows)

    def adjust(self) -> None:
        """Adjust the last keyframes and what they saw; give up what does not fit."""
        first = max(len(self.keyframes) - self.options.adjusted_keyframes, 1)
        if np.linalg.norm(self.lenses.apart - self._adjusted_apart) > (
                self.options.lenses_changed_rad):
            # What was adjusted before was adjusted to other bearings.
            first, self._adjusted_apart = 1, self.lenses.apart
        seen_lately = np.concatenate([one.observations.number for one in self.keyframes[first:]])
        numbers = self._landmarks.number[np.isin(self._landmarks.number, seen_lately)]
        if not len(numbers):
            return
        window = self._window(first, numbers)
        adjusted = adjust(window, self.options.bundle, keep_distance=first == 1)
        self._take_in(first, numbers, window, adjusted)
        self._take_lenses_apart(self.lenses.learn(*lens_equations(window, adjusted)))

    def _window(self, first: int, numbers: Indices) -> Window:
        """Return the Window of the keyframes from ``first`` on, and of landmarks by number."""
        keyframes, rows = self.keyframes, np.searchsorted(self._landmarks.number, numbers)
        shared = [are_among(one.observations.number, numbers) for one in keyframes]
        witnesses = np.argsort([-one.sum() for one in shared[:first]], kind='stable')
        used = [*sorted(witnesses[:self.options.fixed_keyframes]), *range(first, len(keyframes))]
        seen = Observations.joined([keyframes[i].observations[shared[i]] for i in used])
        keyframe_numbers, R, positions = self._poses()
        return Window(
            R, positions, np.arange(len(keyframes)) >= first,
            np.searchsorted(keyframe_numbers, self._landmarks.host[rows]),
            self._landmarks.x[rows], self._landmarks.inverse_depth[rows],
            np.full(len(rows), self.options.window_information),
            np.repeat(used, [shared[i].sum() for i in used]),
            np.searchsorted(numbers, seen.number), seen.y, seen.sqrt_information)

    def _take_in(self, first: int, numbers: Indices, window: Window, adjusted: Adjusted) -> None:
        """Take in a Window that was adjusted; forget landmarks whose observations disagree."""
        options = self.options
        self._all_in_world = None
        fixed = self._covariance_of_fixed(first, window)
        for i, one in enumerate(self.keyframes[first:]):
            one.R, one.position = adjusted.R[first + i], adjusted.p[first + i]
            block = slice(6 * i, 6 * i + 3)
            own = options.covariance_inflation * adjusted.covariance[block, block]
            one.covariance = fixed + own
        rows = np.searchsorted(self._landmarks.number, numbers)
        self._landmarks = self._landmarks.adjusted(rows, adjusted.inverse_depths, np.minimum(
            options.trusted_information * adjusted.information, options.max_information))
        count = np.bincount(window.point, minlength=len(rows))
        trust = np.bincount(window.point, adjusted.weights, len(rows)) / np.maximum(count, 1)
        self._forget(np.isin(
            self._landmarks.number, numbers[(trust < options.min_trust) & (count > 1)]))

    def _covariance_of_fixed(self, first: int, window: Window) -> Covariance:
        """
        Return the covariance (3, 3) of what the orientations of a Window are adjusted to.

        It follows the hosts of its landmarks, whose bearings these are; their errors may all be
        alike. What was born in the window hangs on the keyframe before it.
        """
        known = np.array([one.covariance for one in self.keyframes[:first]])
        hosted = np.bincount(np.minimum(window.host, first - 1), minlength=first)
        return np.average(known, axis=0, weights=hosted)

    def _take_lenses_apart(self, rotvec: Vector) -> None:
        """Correct all bearings known so far by a further rotation vector between the lenses."""
        if not rotvec.any():
            return
        self._move_bearings(apart(self._landmarks.x, rotvec))
        for one in self.keyframes:
            one.observations.y = apart(one.observations.y, rotvec)

    def _move_bearings(self, x: Bearings) -> None:
        self._landmarks, self._all_in_world = replace(self._landmarks, x=x), None

    def _forget(self, gone: Choice) -> None:
        """Let landmarks go, (N,) bool, with their patches."""
        self._store.give_back(self._landmarks.patch[gone])
        self._landmarks = self._landmarks[~gone]
        self._all_in_world = None
