# SPDX-License-Identifier: Apache-2.0
"""Joining the regions of an over-segmented depth image: convex and smooth transitions belong to one object.

Stein et al., "Object Partitioning using Local Convexity", CVPR 2014: objects are mostly convex, and where two objects
touch the edge is concave.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.objects.depth_surfaces import DepthSurface
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


def gap_tolerance(surface: DepthSurface, settings: GeometricSettings) -> np.ndarray:
    """Depth of a step that separates surfaces, float32 [H, W], metres."""
    return np.float32(settings.jump_m) + np.float32(settings.jump_sigmas) * surface.noise()


def find_borders(
    regions: np.ndarray, surface: DepthSurface, normals: np.ndarray, colors: np.ndarray, reach: int,
    settings: GeometricSettings,
) -> Borders:  # fmt: skip
    """Examines every border between regions (int32 [H, W], 0 = none).

    Args:
        colors: float32 [H, W, 3], in a space where distances are differences to the eye.
        normals: float32 [H, W, 3], those of planes where planes are known.
        reach: pixels away from the border at which normals and colours are compared, where edges do not blur them.
    """
    tolerance = gap_tolerance(surface, settings)
    limit = np.cos(np.radians(settings.concave_degrees))
    found = []
    for axis in (1, 0):
        a, b = _link_ends(regions, axis)
        p, q = _shift(a, regions.shape, axis, -reach), _shift(b, regions.shape, axis, reach)
        flat, points, normal = regions.ravel(), surface.points.reshape(-1, 3), normals.reshape(-1, 3)
        color = colors.reshape(-1, 3)
        judged = (flat[p] == flat[a]) & (flat[q] == flat[b])
        p, q = np.where(judged, p, a), np.where(judged, q, b)
        step = points[b] - points[a]
        miss = np.minimum(np.abs((normal[p] * step).sum(1)), np.abs((normal[q] * step).sum(1)))
        # Neither surface, continued, meets the other.
        closed = miss < tolerance.ravel()[a]
        closed &= np.abs(step[:, 2]) < 4 * tolerance.ravel()[a] + 0.02 * points[a, 2]
        cosine = (normal[p] * normal[q]).sum(1)
        opening = ((normal[q] - normal[p]) * (points[q] - points[p])).sum(1)
        judged &= closed
        bent = judged & (cosine < limit)
        contrast = np.linalg.norm(color[p] - color[q], axis=1)
        columns = [np.ones(len(a)), closed, judged, bent & (opening < 0), bent, contrast]
        low, high = np.minimum(flat[a], flat[b]).astype(np.int64), np.maximum(flat[a], flat[b])
        found.append((low << 32 | high, np.stack(columns, 1)))
    codes, place = np.unique(np.concatenate([codes for codes, _ in found]), return_inverse=True)
    values = np.concatenate([values for _, values in found])
    length, closed, judged, concave, bent = (
        np.bincount(place, values[:, k], len(codes)).astype(np.int64) for k in range(values.shape[1] - 1)
    )
    order = np.lexsort((values[:, -1], place))
    middle = np.cumsum(length) - (length + 1) // 2
    pairs = np.stack([codes >> 32, codes & 0xFFFFFFFF], 1)
    return Borders(pairs, length, closed, judged, concave, bent, values[order[middle], -1])


def _link_ends(regions: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices of the pixels on both sides of links (along `axis`) between different regions."""
    first, second = (np.s_[:, :-1], np.s_[:, 1:]) if axis else (np.s_[:-1], np.s_[1:])
    x, y = regions[first], regions[second]
    rows, columns = np.nonzero((x != y) & (x > 0) & (y > 0))
    a = rows * regions.shape[1] + columns
    return a, a + (1 if axis else regions.shape[1])


def _shift(index: np.ndarray, shape: tuple[int, ...], axis: int, by: int) -> np.ndarray:
    rows, columns = np.divmod(index, shape[1])
    if axis:
        columns = (columns + by).clip(0, shape[1] - 1)
    else:
        rows = (rows + by).clip(0, shape[0] - 1)
    return rows * shape[1] + columns


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
