# SPDX-License-Identifier: Apache-2.0
"""Points of a surface with colours and normals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ggslam.scene.poses import transform_points
from ggslam.system.array_forms import Points64

if TYPE_CHECKING:
    from typing_extensions import Self


@dataclass(frozen=True)
class ColoredSurface:
    """Points of a surface.

    Attributes:
        points: float64 [n, 3], metres.
        colors: float [n, 3] in [0, 1].
        normals: float64 [n, 3], unit vectors to the side that was seen.
    """

    points: Points64
    colors: Points64
    normals: Points64

    def __len__(self) -> int:
        return len(self.points)

    def move(self, T: np.ndarray) -> Self:
        """The same moved by [4, 4]."""
        return replace(self, points=transform_points(self.points, T), normals=self.normals @ T[:3, :3].T)

    def at(self, rows: np.ndarray) -> Self:
        """Some of its points."""
        return replace(self, points=self.points[rows], colors=self.colors[rows], normals=self.normals[rows])
