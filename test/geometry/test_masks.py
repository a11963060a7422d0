# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Masks: which pixels are used."""

import cv2
import numpy as np
import pytest

from sph_stab_ros.geometry.equirect import bearing_grid
from sph_stab_ros.geometry.masks import antipodal, load_mask, MaskError


def test_no_mask_uses_everything():
    assert load_mask('', 64) is None
    assert antipodal(None) is None


def test_a_band_of_latitudes_is_left_out():
    used = load_mask('lat:-90,-60', 360)
    lat_deg = np.rad2deg(np.arcsin(-bearing_grid(360)[..., 1]))
    np.testing.assert_array_equal(used, lat_deg > -60)


def test_the_white_of_an_image_is_used(tmp_path):
    image = np.zeros((100, 200), np.uint8)
    image[:50] = 255
    path = tmp_path / 'mask.png'
    cv2.imwrite(str(path), image)
    used = load_mask(str(path), 64)
    assert used[:16].all() and not used[16:].any()


def test_antipodal_masks_hold_the_antipode_of_every_pixel():
    used = np.random.default_rng(0).random((32, 64)) > 0.3
    symmetric = antipodal(used)
    grid = bearing_grid(64)
    for v, u in np.argwhere(symmetric)[::50]:
        opposite = np.argmin(np.sum((grid + grid[v, u]) ** 2, axis=-1))
        assert symmetric.flat[opposite] and used[v, u]
    np.testing.assert_array_equal(antipodal(symmetric), symmetric)
    assert symmetric.any()


@pytest.mark.parametrize('spec, reason', [
    ('lat:-90', 'form'), ('lat:a,b', 'form'), ('lat:10,-10', 'FROM < TO'), ('lat:0,91', '<= 90'),
    ('lat:-90,90', 'no pixel'), ('no/such.png', 'cannot be read')])
def test_bad_masks_are_refused_with_the_reason(spec, reason):
    with pytest.raises(MaskError, match=reason):
        load_mask(spec, 64)


def test_masks_must_be_spheres(tmp_path):
    path = tmp_path / 'square.png'
    cv2.imwrite(str(path), np.full((64, 64), 255, np.uint8))
    with pytest.raises(MaskError, match='64x64, not 2:1'):
        load_mask(str(path), 64)
