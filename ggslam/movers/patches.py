# SPDX-License-Identifier: Apache-2.0
"""What a frame shows of one mover: points of its surface with colours and normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.geometry.colored_surface import ColoredSurface
from ggslam.geometry.normals import estimate_normals, turn_toward
from ggslam.scene.camera import Camera
from ggslam.system.savable import savable

MOST = 2000
"""Points: of more they are taken at regular distances."""
_FEWEST, _NEIGHBOURS = 12, 9
_OUTLYING = 3.0
"""Points so many times farther from the middle than half of them are of something else: masks are not exact."""


@savable()
@dataclass(frozen=True)
class Patch(ColoredSurface):
    """Surface seen in one frame."""

    def some(self, most: int) -> Patch:
        """So many of its points at most, drawn alike every time."""
        if len(self) <= most:
            return self
        return self.at(np.random.default_rng(0).permutation(len(self))[:most])


def patch_of(mask: np.ndarray, depth: np.ndarray, color: np.ndarray, camera: Camera) -> Patch | None:
    """What is on a mask bool [H, W], in the camera's axes; None: too little."""
    v, u = np.nonzero(mask & (depth > 0))
    if len(v) < _FEWEST:
        return None
    step = int(np.ceil(np.sqrt(len(v) / MOST)))
    if step > 1:
        chosen = (v % step == 0) & (u % step == 0)
        v, u = v[chosen], u[chosen]
    z = depth[v, u].astype(float)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], 1)
    off = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    kept = off <= _OUTLYING * np.median(off)
    if kept.sum() < _FEWEST:
        return None
    points = points[kept]
    normals = turn_toward(estimate_normals(points, neighbours=_NEIGHBOURS, workers=1), -points)
    return Patch(points, color[v, u][kept] / 255.0, normals)
