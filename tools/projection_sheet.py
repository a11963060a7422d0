# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Draw docs/projections.jpg: a sphere in every projection, and read back out of it.

``python3 tools/projection_sheet.py bags/drone docs/projections.jpg``: of the first picture of an
equirectangular recording.
"""

from pathlib import Path
import sys

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sph_stab_ros.config import CropConfig, FisheyeConfig, LensConfig, StabilizerConfig
from sph_stab_ros.geometry.projection import Equirect
from sph_stab_ros.geometry.projection_factory import projection_of
from sph_stab_ros.geometry.warp import equirect_warp, perspective_warp, view_rotation
from sph_stab_ros.recording import open_recording

UPRIGHT = {'k1': 0., 'k2': 0., 'roll_deg': 0.}
# Read back as half a sphere wide, and as a view to the left and up.
SPHERE_WIDTH, VIEW_WH, HFOV_RAD = 256, (128, 128), np.deg2rad(90)
LOOK = view_rotation(np.deg2rad(40), np.deg2rad(25))
CELL_WH, LABEL_PX, MARGIN_PX, COLUMNS = (384, 240), 22, 6, 4


def circles(size_wh, *centers_px, fov_deg=200., model='equidistant', radius_px=230., **lens):
    """Return the FisheyeConfig of one circle or of two, around centres."""
    lenses = [LensConfig(*center, radius_px, yaw_deg=yaw_deg, **UPRIGHT | lens)
              for center, yaw_deg in zip(centers_px, (0., 180.))]
    return FisheyeConfig(*size_wh, fov_deg=fov_deg, model=model,
                         **dict(zip(('front', 'rear'), lenses)))


def example(size_wh, projection, **options):
    """Return the size of a picture and its config."""
    return size_wh, StabilizerConfig(projection=projection, **options)


ONE, SIDE, BELOW = (255.5, 255.5), (767.5, 255.5), (255.5, 767.5)
EXAMPLES = {
    'equirect': example((1024, 512), 'equirect'),
    'stretched_equirect 16:9': example((1024, 576), 'stretched_equirect'),
    'cropped_equirect': example((1024, 300), 'cropped_equirect', crop=CropConfig(
        1024, 512, 0, 100, 1024, 300)),
    'cropped_equirect: half': example((512, 512), 'cropped_equirect', crop=CropConfig(
        left=.25, width=.5)),
    'cubemap 3x2': example((768, 512), 'cubemap'),
    'cubemap 6x1': example((1536, 256), 'cubemap'),
    'cubemap 1x6': example((256, 1536), 'cubemap'),
    'cubemap 4x3': example((1024, 768), 'cubemap'),
    'equi_angular_cubemap': example((1280, 720), 'equi_angular_cubemap'),
    'gopro_max': example((780, 512), 'gopro_max'),
    'dual_fisheye side by side': example(
        (1024, 512), 'dual_fisheye', fisheye=circles((1024, 512), ONE, SIDE)),
    'dual_fisheye above': example(
        (512, 1024), 'dual_fisheye', fisheye=circles((512, 1024), ONE, BELOW)),
    'fisheye 180': example(
        (512, 512), 'fisheye', fisheye=circles((512, 512), ONE, fov_deg=180., radius_px=256.)),
    'fisheye 280': example(
        (512, 512), 'fisheye', fisheye=circles((512, 512), ONE, fov_deg=280., radius_px=164.)),
    'fisheye equisolid 220': example((512, 512), 'fisheye', fisheye=circles(
        (512, 512), ONE, fov_deg=220., model='equisolid', radius_px=192.)),
    'fisheye polynomial, cut': example((640, 440), 'fisheye', fisheye=circles(
        (640, 440), (319.5, 219.5), k1=-0.01, k2=0.02, k3=-0.015, k4=0.003)),
}


def rendered(projection, photo, size_wh):
    """Return the picture that a projection makes of a sphere."""
    if isinstance(projection, Equirect):
        return cv2.resize(photo, size_wh, interpolation=cv2.INTER_AREA)
    uv = np.stack(np.meshgrid(*map(np.arange, size_wh)), axis=-1).astype(float)
    xyz, shown = projection.bearings(uv)
    planes = np.ascontiguousarray(np.moveaxis(xyz, -1, 0), np.float32)
    picture = Equirect(photo.shape[1]).read(photo, *planes)
    picture[~shown] = 0
    return picture


def cell(name, size_wh, config, photo):
    """Return a labelled cell: the picture, the sphere out of it, and a view."""
    projection = projection_of(size_wh, config)
    picture = rendered(projection, photo, size_wh)
    sphere = equirect_warp(1024)(picture, Rotation.identity(), projection)
    view = perspective_warp(HFOV_RAD, *(2 * one for one in VIEW_WH))(picture, LOOK, projection)
    width, height = CELL_WH
    sheet = np.full((height, width, 3), 255, np.uint8)
    upper = height - VIEW_WH[1] - LABEL_PX
    scale = min(width / size_wh[0], upper / size_wh[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    left = (width - small.shape[1]) // 2
    sheet[LABEL_PX:LABEL_PX + small.shape[0], left:left + small.shape[1]] = small
    sheet[-VIEW_WH[1]:, :SPHERE_WIDTH] = cv2.resize(
        sphere, (SPHERE_WIDTH, SPHERE_WIDTH // 2), interpolation=cv2.INTER_AREA)
    sheet[-VIEW_WH[1]:, SPHERE_WIDTH:] = cv2.resize(view, VIEW_WH, interpolation=cv2.INTER_AREA)
    cv2.putText(sheet, name, (2, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return cv2.copyMakeBorder(sheet, *(4 * (MARGIN_PX,)), cv2.BORDER_CONSTANT,
                              value=(255, 255, 255))


def main(recording, out_path):
    """Write the sheet."""
    first = next(open_recording(Path(recording)).frames())
    photo = cv2.resize(first.image, (2048, 1024), interpolation=cv2.INTER_CUBIC)
    cells = [cell(name, *one, photo) for name, one in EXAMPLES.items()]
    cells += [np.full_like(cells[0], 255)] * (-len(cells) % COLUMNS)
    rows = [np.hstack(cells[i:i + COLUMNS]) for i in range(0, len(cells), COLUMNS)]
    cv2.imwrite(out_path, np.vstack(rows), (cv2.IMWRITE_JPEG_QUALITY, 80))


if __name__ == '__main__':
    main(*sys.argv[1:])
