# SPDX-License-Identifier: Apache-2.0
"""Joining the regions of an over-segmented depth image: convex and smooth transitions belong to one object.

Stein et al., "Object Partitioning using Local Convexity", CVPR 2014: objects are mostly convex, and where two objects
touch the edge is concave.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.objects.depth_surface import DepthSurface
from ggslam.objects.pixel_passes import count_borders
from ggslam.objects.settings import GeometricSettings


@dataclass(frozen=True)
class Borders:
    """What lies between pairs of touching regions, counted over the links between their pixels.

    Attributes:
        pairs: int64 [n, 2], region numbers, smaller first.
        length: int64 [n], links.
        closed: links without a gap between the surfaces.
        judged: closed links where both regions reach far enough to compare normals.
        concave: judged links that are a concave edge.
        bent: judged links that are any edge (convex or concave).
        contrast: median difference of colour across the links, float64 [n].
    """

    pairs: np.ndarray
    length: np.ndarray
    closed: np.ndarray
    judged: np.ndarray
    concave: np.ndarray
    bent: np.ndarray
    contrast: np.ndarray


def find_borders(
    regions: np.ndarray, surface: DepthSurface, plane_of: np.ndarray, planes: np.ndarray, colors: np.ndarray,
    reach: int, settings: GeometricSettings,
) -> Borders:  # fmt: skip
    """Examines every border between regions (int32 [H, W], 0 = none).

    Args:
        colors: float32 [H, W, 3], in a space where distances are differences to the eye.
        plane_of: int32 [H, W], number of each pixel's plane from 1 on, 0 = none: there its normal counts.
        planes: float32 [P, 3], vectors w with 1/z = w . ray.
        reach: pixels away from the border at which normals and colours are compared, where edges do not blur them.
    """
    pairs, counts, contrast = count_borders(regions, surface, plane_of, planes, colors, reach, settings)
    length, closed, judged, concave, bent = counts.T
    return Borders(pairs, length, closed, judged, concave, bent, contrast)


class Groups:
    """Disjoint sets of region numbers 0 to n - 1."""

    def __init__(self, n: int) -> None:
        self._parent = list(range(n))

    def find(self, k: int) -> int:
        while self._parent[k] != k:
            self._parent[k] = self._parent[self._parent[k]]
            k = self._parent[k]
        return k

    def join(self, a: int, b: int) -> None:
        a, b = self.find(a), self.find(b)
        self._parent[max(a, b)] = min(a, b)

    def roots(self) -> np.ndarray:
        return np.array([self.find(k) for k in range(len(self._parent))])
