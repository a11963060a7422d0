# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""
Check the rendered panorama against the package's pixel convention.

Glowing balls at known places are rendered along a shaking flight, motion blur on; their centroids
must lie where `pixels_from_bearings` says, within 0.5 px. The last test is the rolling shutter: a
row's balls must lie where the camera's pose at that row's own time puts them.
"""

from pathlib import Path
import sys
import tempfile

import bpy
import camera
import cv2
import materials
import numpy as np
from shapes import Shapes

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
WIDTH, TOLERANCE_PX = 640, 0.5


def render_balls(flight, points, times, span_s, readout_share):
    """Render balls at `points` (N, 3) at each time; yield float images (H, W)."""
    eye = camera.setup(WIDTH, 48, readout_share)
    bpy.context.scene.cycles.use_denoising = False
    bpy.context.scene.view_settings.view_transform = 'Raw'
    balls = Shapes(materials.glow('ball', (1.0, 1.0, 1.0), 0.9))
    for point in points:
        balls.ellipsoid(point, (0.03,) * 3, (1.0, 1.0, 1.0), sides=24)
    balls.link('balls')
    movers = [camera.follow(eye, flight)]
    with tempfile.TemporaryDirectory() as folder:
        for index, t_s in enumerate(times):
            camera.expose(movers, index, t_s, span_s)
            path = Path(folder) / f'{index}.png'
            bpy.context.scene.render.filepath = str(path)
            bpy.ops.render.render(write_still=True)
            yield cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(float)


def offset_px(image, bearings, expected):
    """Return the angle between a ball's centroid and its expected bearing, in pixels."""
    near = (bearings @ expected > np.cos(np.deg2rad(5.0))) * image
    weight = near * np.linalg.norm(bearings[..., [0, 2]], axis=-1)
    if weight.sum() == 0.0:
        return np.inf
    centre = np.einsum('ij,ijk->k', weight, bearings)
    angle = np.arctan2(np.linalg.norm(np.cross(centre, expected)), centre @ expected)
    return angle / (2 * np.pi / WIDTH)


def main():
    """Report the worst offset for a global and a rolling shutter."""
    from sph_stab_ros.geometry.equirect import bearings_from_pixels, pixels_from_bearings
    from sph_stab_ros.simulation import flights
    flight = flights.shake(seed=3, frames=40)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(14, 3))
    points = points / np.linalg.norm(points, axis=1, keepdims=True) * 2.5 + (0.0, 0.0, 1.6)
    grid = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(WIDTH // 2)), axis=-1).astype(float)
    bearings = bearings_from_pixels(grid, WIDTH)
    times = flight.frame_times_s[3::7]
    exposure_s, readout_s = 0.01, 0.02
    for name, readout in (('global shutter', 0.0), ('rolling shutter', readout_s)):
        span_s = exposure_s + readout
        worst = 0.0
        images = render_balls(flight, points, times, span_s, readout / span_s)
        for t_s, image in zip(times, images):
            for point in points:
                row_s = t_s
                for _ in range(4):
                    seen = flight.R_mocap_camera(row_s).inv().apply(
                        point - flight.p_mocap_camera(row_s))
                    seen /= np.linalg.norm(seen)
                    row = pixels_from_bearings(seen, WIDTH)[1]
                    row_s = t_s + readout * ((row + 0.5) / (WIDTH / 2) - 0.5)
                worst = max(worst, offset_px(image, bearings, seen))
        print(f'{name}: {len(times)} views of {len(points)} balls, worst offset {worst:.3f} px')
        if worst > TOLERANCE_PX:
            sys.exit('check_convention: the renderer is off the convention')


if __name__ == '__main__':
    main()
