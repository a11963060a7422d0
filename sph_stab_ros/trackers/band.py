# Copyright 2026 The sph_stab_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The stabilised sphere between two latitudes, as a picture to follow corners in."""

import cv2
import numpy as np

from sph_stab_ros.equirect import bearings_from_pixels, pixels_from_bearings
from sph_stab_ros.warp import InverseWarp

# Nearer to the poles the picture is too distorted for a square window.
MAX_LATITUDE_RAD = np.deg2rad(65)
# Continued across the seam by the reach of a window on the coarsest level.
MARGIN_PX = 48
WINDOW_PX = 15
PYRAMID_LEVELS = 2
MIN_CORNER_DISTANCE_PX = 10
MAX_CORNERS = 600
MIN_CORNER_QUALITY = 1e-3
# Smallest eigenvalue of a window's structure tensor, per pixel, that can be followed.
MIN_EIGENVALUE = 5e-4
# Mean grey difference of a window that has been followed to the wrong place.
MAX_DIFFERENCE = 25
GRADIENT0 = 30.


class Band:
    """Latitudes up to 65° of a sphere ``width`` wide: where pixels and bearings of it are."""

    def __init__(self, width):
        self.width = width
        self.first_row = round(width / 2 * (0.5 - MAX_LATITUDE_RAD / np.pi))
        self.size_wh = width + 2 * MARGIN_PX, width // 2 - 2 * self.first_row
        self._offset_px = np.float32((MARGIN_PX, -self.first_row))
        self._warp = InverseWarp(
            lambda uv: bearings_from_pixels(uv - self._offset_px, width), self.size_wh)

    def look(self, grey, R_world_camera):
        """Return the band's picture of the grey sphere (H, W) in the world's orientation."""
        return self._warp(grey, R_world_camera.inv())

    def bearings(self, uv):
        """Return the bearings (N, 3) of the band's pixels (N, 2)."""
        return bearings_from_pixels(uv.astype(float) - self._offset_px, self.width)

    def pixels(self, bearings):
        """Return the band's pixels (N, 2) of bearings (N, 3)."""
        return np.float32(pixels_from_bearings(bearings, self.width) + self._offset_px)

    def contains(self, uv):
        """Tell which pixels (N, 2) lie far enough within the band to be followed."""
        reach = WINDOW_PX / 2
        return (uv[:, 1] > reach) & (uv[:, 1] < self.size_wh[1] - reach)

    def corners(self, image, taken):
        """Return corners (N, 2) of a picture, away from those already ``taken`` (M, 2)."""
        free = np.zeros(self.size_wh[::-1], np.uint8)
        free[WINDOW_PX:-WINDOW_PX, MARGIN_PX:-MARGIN_PX] = 255
        for u, v in np.rint(taken).astype(int).tolist():
            cv2.circle(free, (u, v), MIN_CORNER_DISTANCE_PX, 0, -1)
        wanted = MAX_CORNERS - len(taken)
        if wanted <= 0:
            return np.empty((0, 2), np.float32)
        found = cv2.goodFeaturesToTrack(
            image, wanted, MIN_CORNER_QUALITY, MIN_CORNER_DISTANCE_PX,
            mask=free, blockSize=7)
        return np.empty((0, 2), np.float32) if found is None else found[:, 0]

    def root_information(self, image, uv):
        gx,gy=cv2.Scharr(image,cv2.CV_32F,1,0)/32,cv2.Scharr(image,cv2.CV_32F,0,1)/32
        box=lambda a: cv2.boxFilter(a,-1,(WINDOW_PX,WINDOW_PX))
        i,j=np.rint(uv[:,::-1]).astype(int).T
        G=np.array([[box(gx*gx)[i,j],box(gx*gy)[i,j]],[box(gx*gy)[i,j],box(gy*gy)[i,j]]]).transpose(2,0,1).astype(float)
        l,V=np.linalg.eigh(G)
        f=np.sqrt(np.maximum(l,1e-6)/(l+GRADIENT0))*self.width/(2*np.pi)/0.2
        return np.einsum('nij,nj,nkj->nik',V,f,V)

    def whitening(self, y, root):
        c=np.maximum(np.hypot(y[:,0],y[:,2]),.1)
        e=np.stack((y[:,2],0*c,-y[:,0]),-1)/(c*c)[:,None]
        s=np.cross(y,e*c[:,None])
        T=np.stack((e,s))
        return np.einsum('nij,jnk->ink',root,T)


def follow(before, now, uv_before, uv_now):
    """
    Return where corners (N, 2) of one picture are in another, and which were found (N,).

    Pyramidal Lucas–Kanade from the guesses ``uv_now`` (N, 2).
    """
    uv, found, difference = cv2.calcOpticalFlowPyrLK(
        before, now, uv_before, uv_now.copy(), winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=PYRAMID_LEVELS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.01),
        minEigThreshold=MIN_EIGENVALUE)
    return uv, (found[:, 0] > 0) & (difference[:, 0] < MAX_DIFFERENCE)
