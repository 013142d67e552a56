# SPDX-License-Identifier: Apache-2.0
"""What a frame shows of one mover: points of its surface with colours and normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.geometry.normals import estimate_normals
from ggslam.scene.camera import Camera
from ggslam.scene.poses import transform_points

MOST = 500
"""Points: of more they are taken at regular distances."""
_FEWEST, _NEIGHBOURS = 12, 9
_OUTLYING = 3.0
"""Points so many times farther from the middle than half of them are of something else: masks are not exact."""


@dataclass(frozen=True)
class Patch:
    """Surface seen in one frame.

    Attributes:
        points: float64 [n, 3], metres.
        colors: float64 [n, 3] in [0, 1].
        normals: float64 [n, 3], unit vectors to the side that was seen.
    """

    points: np.ndarray
    colors: np.ndarray
    normals: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    def move(self, T: np.ndarray) -> Patch:
        """The same moved by [4, 4]."""
        return Patch(transform_points(self.points, T), self.colors, self.normals @ T[:3, :3].T)

    def some(self, most: int) -> Patch:
        """So many of its points at most, drawn alike every time."""
        if len(self) <= most:
            return self
        rows = np.random.default_rng(0).permutation(len(self))[:most]
        return Patch(self.points[rows], self.colors[rows], self.normals[rows])


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
    normals = estimate_normals(points, neighbours=_NEIGHBOURS, workers=1)
    normals *= -np.sign((normals * points).sum(1))[:, None]
    return Patch(points, color[v, u][kept] / 255.0, normals)
