# SPDX-License-Identifier: Apache-2.0
"""Parts of one plane that are not one thing: pictures on a wall have one plane, as have the tops of like tables.

Where something stands before a plane it may go on behind; where the camera sees through to what is farther, there is
none of it. Parts between which one always sees through are things of their own.
"""

from __future__ import annotations

import cv2
import numpy as np

from ggslam.objects.depth_surface import DepthSurface
from ggslam.objects.pixel_passes import connected_pieces
from ggslam.objects.settings import GeometricSettings
from ggslam.scene.camera import Camera


def part_planes(
    plane_of: np.ndarray, planes: np.ndarray, surface: DepthSurface, camera: Camera, settings: GeometricSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Planes as of `find_planes`, those whose parts have nothing in common split.

    Returns:
        int32 [H, W] and float32 [P', 3]; the largest part keeps the plane's number, others come after all planes, and
        parts below the least area of a segment stay with it.
    """
    out, more = plane_of.copy(), [planes]
    x, y = camera.rays()[:1, :, 0], camera.rays()[:, :1, 1]
    tolerance = settings.tolerance_sigmas * surface.sigma + settings.tolerance_m * surface.inverse**2
    pieces = connected_pieces(plane_of)
    area = np.bincount(pieces.ravel())
    least = settings.min_area * plane_of.size
    owner = np.zeros(len(area), np.int32)
    owner[pieces.ravel()] = plane_of.ravel()
    count = len(planes)
    for number in range(1, len(planes) + 1):
        parts = np.flatnonzero((owner == number) & (area >= least))
        if len(parts) < 2:
            continue
        plane = planes[number - 1]
        here = plane[0] * x + (plane[1] * y + plane[2])
        inside = plane_of == number
        # On the plane or before it, or unknown; what another plane has is on that one, however near it is.
        reach = np.where(plane_of > 0, 0, tolerance)
        opaque = (surface.inverse > here - reach) | ~surface.valid | inside
        opaque &= here > 0
        _, group = cv2.connectedComponents(opaque.astype(np.uint8), connectivity=4, ltype=cv2.CV_32S)
        of_piece = np.zeros(len(area), np.int32)
        of_piece[pieces[inside]] = group[inside]
        sizes = {g: int(area[parts][of_piece[parts] == g].sum()) for g in set(of_piece[parts].tolist())}
        main = max(sizes, key=lambda g: (sizes[g], -g))
        for g in sorted(sizes):
            if g != main:
                count += 1
                out[inside & np.isin(pieces, parts[of_piece[parts] == g])] = count
                more.append(plane[None])
    return out, np.concatenate(more)
