# SPDX-License-Identifier: Apache-2.0
"""Flat faces of one body that a step parts: the top of a table stands out over its front, that of a cabinet over its
doors. The faces of a convex body lie behind one another's planes, all but the rim that stands out."""

from __future__ import annotations

import numpy as np

from ggslam.objects.depth_surface import DepthSurface
from ggslam.objects.regions import Groups
from ggslam.system.tuning import Tuning


class OverhangTuning(Tuning):
    """When a step parts two faces of one body."""

    max_step_m = 0.15
    """Largest overhang of a face over another, in metres."""
    clear_m = 0.003
    """Distance behind the other's plane from which a point is behind it, in metres."""
    min_behind = 0.6
    """Smallest share of a face's points behind the other's plane."""
    flatness = (0.15, 0.003)
    """Largest thickness of a flat face (root mean square): a share of its width, plus metres."""
    max_corner_cosine = 0.64
    """Largest cosine between the normals of two faces: 50 degrees."""
    min_parallel = 0.9
    """Smallest cosine between the normals of parallel faces."""
    min_rim = 0.12
    """Smallest share of one outline along the border."""
    min_border = 12
    """Fewest pixels of border."""
    min_face = 30
    """Fewest pixels of a face on a grid of every second."""
    points = 400
    """Points of a face that are used, about."""


def join_overhangs(groups: Groups, regions: np.ndarray, surface: DepthSurface, pairs: np.ndarray) -> None:
    """Joins flat regions that are faces of one convex body.

    Args:
        groups: of the regions; changed in place.
        regions: int32 [H, W], 0 = none.
        pairs: int [n, 3], touching regions with the number of links between them.
    """
    n = len(groups.roots())
    rim = np.bincount(pairs[:, :2].ravel(), np.repeat(pairs[:, 2], 2), n)
    fewer = rim[pairs[:, :2]].min(1)
    asked = pairs[(pairs[:, 2] >= OverhangTuning.min_border) & (pairs[:, 2] >= OverhangTuning.min_rim * fewer)]
    if not len(asked):
        return
    faces = _Faces(regions, surface, n)
    for a, b, _ in asked.tolist():
        if groups.find(a) != groups.find(b) and (
            faces.are_corner(a, b) or faces.is_below(groups, a, b) or faces.is_below(groups, b, a)
        ):
            groups.join(a, b)


class _Faces:
    """Points and normals of regions, on every second pixel and row, of each region at most some hundreds."""

    def __init__(self, regions: np.ndarray, surface: DepthSurface, n: int) -> None:
        number = regions[::2, ::2].ravel()
        order = np.argsort(number, kind="stable")
        count = np.bincount(number, minlength=n)
        rank = np.arange(len(order)) - (np.cumsum(count) - count)[number[order]]
        some = order[rank % np.maximum(1, count // OverhangTuning.points)[number[order]] == 0]
        self._points = surface.points[::2, ::2].reshape(-1, 3)[some]
        self._start = np.searchsorted(number[some], np.arange(n + 1))
        self._is_face = count >= OverhangTuning.min_face
        self._is_face[0] = False
        self._fit(number[some], n)
        self._heights: dict[int, float] = {}

    def _fit(self, number: np.ndarray, n: int) -> None:
        """Normals towards the camera of the regions that are flat."""
        size = np.diff(self._start)
        centre = _sums(self._points.astype(np.float64), number, n) / np.maximum(size, 1)[:, None]
        away = self._points - centre[number]
        spread = _sums((away[:, :, None] * away[:, None, :]).reshape(-1, 9), number, n).reshape(-1, 3, 3)
        values, axes = np.linalg.eigh(spread / np.maximum(size - 1, 1)[:, None, None])
        thickness, width = np.sqrt(np.maximum(values[:, :2], 0)).T
        self._is_face &= thickness <= OverhangTuning.flatness[0] * width + OverhangTuning.flatness[1]
        normals = axes[:, :, 0]
        self._normals = np.where(((normals * centre).sum(1) > 0)[:, None], -normals, normals)

    def _normal(self, k: int) -> np.ndarray | None:
        return self._normals[k] if self._is_face[k] else None

    def _some(self, k: int) -> np.ndarray:
        return self._points[self._start[k] : self._start[k + 1]]

    def _height(self, k: int) -> float:
        """Where the plane of a flat region is, along its normal."""
        if k not in self._heights:
            heights = self._some(k) @ self._normals[k]
            self._heights[k] = np.partition(heights, len(heights) // 2)[len(heights) // 2]
        return self._heights[k]

    def are_corner(self, a: int, b: int) -> bool:
        """Whether both are flat, stand at an angle and lie behind one another."""
        n, m = self._normal(a), self._normal(b)
        if n is None or m is None or n @ m > OverhangTuning.max_corner_cosine:
            return False
        return self._is_behind(a, b) and self._is_behind(b, a)

    def is_below(self, groups: Groups, a: int, edge: int) -> bool:
        """Whether `a` is set back behind the parallel `edge` of a board that lies on it: a front below a table top."""
        n, m = self._normal(a), self._normal(edge)
        if n is None or m is None or n @ m < OverhangTuning.min_parallel or not self._is_behind(a, edge):
            return False
        root = groups.find(edge)
        boards = [k for k in range(1, len(self._is_face)) if k not in (a, edge) and groups.find(k) == root]
        return any(self.are_corner(a, k) for k in boards)

    def _is_behind(self, a: int, b: int) -> bool:
        """Whether the points of `a` lie behind the face `b`, but for what may stand out, and reach up to it."""
        out = np.sort(self._some(a) @ self._normals[b]) - self._height(b)
        high = out[round(0.98 * (len(out) - 1))]
        return bool(
            out[int(OverhangTuning.min_behind * (len(out) - 1))] < -OverhangTuning.clear_m
            and -OverhangTuning.max_step_m < high < OverhangTuning.max_step_m
        )


def _sums(rows: np.ndarray, number: np.ndarray, n: int) -> np.ndarray:
    """Sums of the rows [m, c] of each number below n: float64 [n, c]."""
    return np.stack([np.bincount(number, column, n) for column in rows.T], 1)
