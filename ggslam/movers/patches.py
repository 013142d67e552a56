# SPDX-License-Identifier: Apache-2.0
"""A patch: the visible surface of one mover in a frame, as points with colours and normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.geometry.colored_surface import ColoredSurface
from ggslam.geometry.normals import estimate_normals, turn_toward
from ggslam.scene.camera import Camera
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class PatchTuning(Tuning):
    """Points of a mover in one frame."""

    max_points = 2000
    """Most points, spread evenly."""
    min_points = 12
    """Fewest points."""
    neighbours = 9
    """Points that a normal is estimated from."""
    max_distance = 3.0
    """Largest distance of a point from the centre, in medians: masks are not exact."""


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
    if len(v) < PatchTuning.min_points:
        return None
    step = int(np.ceil(np.sqrt(len(v) / PatchTuning.max_points)))
    if step > 1:
        chosen = (v % step == 0) & (u % step == 0)
        v, u = v[chosen], u[chosen]
    z = depth[v, u].astype(float)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], 1)
    off = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    kept = off <= PatchTuning.max_distance * np.median(off)
    if kept.sum() < PatchTuning.min_points:
        return None
    points = points[kept]
    normals = turn_toward(estimate_normals(points, neighbours=PatchTuning.neighbours, workers=1), -points)
    return Patch(points, color[v, u][kept] / 255.0, normals)
