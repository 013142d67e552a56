# SPDX-License-Identifier: Apache-2.0
"""The reference of `bench_submaps.py`: G-ICP with the nearest of all the map's points, found by a k-d tree.

This is how localisation in a cloud is mostly done: a tree
over the map's points, which takes the longer to build, to fill and to search the larger the map is. Nothing of
`ggslam.tracking` is used, so that what the voxels of `GicpTarget` do for the time can be seen, too.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "submaps"))

import numpy as np
from partial_map import PartialMap
from scipy.spatial import cKDTree

from ggslam.localization.localizer import FrontEndResult, LocalizationStatus
from ggslam.localization.surface import load_surface
from ggslam.scene.poses import inverse, orthonormalize, se3_exp
from ggslam.submaps.cell_keys import CellKey
from ggslam.submaps.cell_points import CellArrays
from ggslam.submaps.cells_around import MapStatus
from ggslam.submaps.grid import GridStore
from ggslam.submaps.settings import SubmapSettings
from ggslam.tracking.scan_points import ScanSettings, scan_points

_ITERATIONS = 30
_REACH = 0.6
"""Metres to the farthest match."""
_KERNEL = 0.1
"""Width of the Geman-McClure kernel, metres."""
_FLAT = 0.01
"""Variance of a map's point along its normal, in units of that along the surface; also a scan point's."""
_SMALL = 1e-4
"""Metres and radians of the last step."""
_MIN_OVERLAP = 0.5


@dataclass(frozen=True)
class TreeTarget:
    """Points and unit normals float32 [n, 3], and a tree of the points."""

    points: np.ndarray
    normals: np.ndarray
    tree: cKDTree


def _load(store: GridStore, key: CellKey) -> CellArrays:
    points, normals, _ = load_surface(store, key)
    return {"points": points, "normals": normals}


def _target(arrays: CellArrays) -> TreeTarget | None:
    points = arrays["points"]
    return TreeTarget(points, arrays["normals"], cKDTree(points)) if len(points) else None


class TreeSurface:
    """A `Surface` whose target is a `TreeTarget`: of the cells within R', made anew when the sensor enters a cell, or,
    with `full`, of the whole map, made once."""

    def __init__(self, store: GridStore, submaps: SubmapSettings, full: bool) -> None:
        self.target: TreeTarget | None = None
        self.has_sides, self.damage = True, ()
        everything = replace(submaps, partial_radius=1e7, lookahead=0.0, cache_megabytes=0.0)
        self.map = PartialMap(store, everything if full else submaps, _load)
        self._done, self._full = False, full

    @property
    def points(self) -> int:
        """Points of the target."""
        return 0 if self.target is None else len(self.target.points)

    def move_to(self, position: np.ndarray, velocity: np.ndarray | None = None) -> bool:
        """See `Surface`."""
        if self._done and self._full:
            return False
        self._done = True
        if self.map.update(position, velocity) is MapStatus.UNCHANGED:
            return False
        self.target = _target(self.map.arrays)
        return True

    def close(self) -> None:
        """Ends loading ahead."""
        self.map.close()


class TreeTracker:
    """A `FrontEnd`: aligns scans to the target of a `TreeSurface` from where constant velocity leads."""

    def __init__(self, T_world_sensor: np.ndarray) -> None:
        self._pose, self._velocity = np.array(T_world_sensor, float), np.eye(4)

    def track(self, item: np.ndarray, surface: TreeSurface, target: TreeTarget) -> FrontEndResult:
        """See `FrontEnd`."""
        points = scan_points(item, ScanSettings()).points.astype(np.float64)
        T, overlap, rmse = aligned(points, target, self._pose @ self._velocity)
        if overlap < _MIN_OVERLAP:
            self._velocity = np.eye(4)
            return FrontEndResult(self._pose.copy(), LocalizationStatus.LOST, overlap, rmse, "too few matches")
        self._velocity, self._pose = inverse(self._pose) @ T, T
        return FrontEndResult(T.copy(), LocalizationStatus.OK, overlap, rmse)

    def look_up(self, item: np.ndarray, surface: TreeSurface) -> FrontEndResult | None:
        """See `FrontEnd`."""
        return None


def aligned(points: np.ndarray, target: TreeTarget, T: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Pose [4, 4] of points [n, 3] from a guess, the share of them within the kernel's width of a surface, and the root
    mean square of their distances in metres. Gauss-Newton; each iteration searches anew."""
    along, across = 1 / (1 + _FLAT), 1 / (_FLAT + _FLAT)  # 1 / variance of a match, along the surface and across it
    overlap, rmse = 0.0, 0.0
    for _ in range(_ITERATIONS):
        arms = points @ T[:3, :3].T
        moved = arms + T[:3, 3]
        _, nearest = target.tree.query(moved, distance_upper_bound=_REACH, workers=-1)
        near = np.nonzero(nearest < len(target.points))[0]
        near = near[(target.normals[nearest[near]] * arms[near]).sum(1) < 0]  # what is seen faces the sensor
        n = target.normals[nearest[near]].astype(np.float64)
        d, arm = target.points[nearest[near]] - moved[near], arms[near]
        plane = (n * d).sum(1)
        inside = np.abs(plane) < _KERNEL
        overlap, rmse = float(inside.sum() / max(1, len(points))), float(np.sqrt((plane[inside] ** 2).mean()))
        if len(near) < 50:
            return T, 0.0, 0.0
        squared = (along * (d**2).sum(1) + (across - along) * plane**2) / across
        weight = (_KERNEL**2 / (_KERNEL**2 + squared)) ** 2
        M = along * np.eye(3) + (across - along) * n[:, :, None] * n[:, None, :]
        J = np.concatenate([np.tile(np.eye(3), (len(near), 1, 1)), -_cross(arm)], 2)
        WJ = weight[:, None, None] * (M @ J)
        H = np.einsum("nki,nkj->ij", J, WJ)
        step = np.linalg.solve(H, np.einsum("nki,nk->i", WJ, d))
        turn = se3_exp(np.concatenate([np.zeros(3), step[3:]]))[:3, :3]
        T = T.copy()
        T[:3, :3], T[:3, 3] = turn @ T[:3, :3], T[:3, 3] + step[:3]
        if np.abs(step).max() < _SMALL:
            break
    return orthonormalize(T), overlap, rmse


def _cross(v: np.ndarray) -> np.ndarray:
    """Matrices [n, 3, 3] of the cross products with v [n, 3]."""
    x, y, z = v.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
