# SPDX-License-Identifier: Apache-2.0
"""Chooses the run whose map is kept at a place that several runs mapped: the one that measured it best.

A map is right where its keyframes looked. At the border of what they saw it is not: Gaussians that fit the few views
there are wrong from elsewhere. So each place belongs to one run as a whole, and the border between two runs' places
lies where both saw it about as well.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from ggslam.geometry.voxels import neighbour_step, voxel_centres, voxel_keys
from ggslam.merging.known_run import KnownRun
from ggslam.scene.poses import transform_points
from ggslam.system.tuning import Tuning


class OwnershipTuning(Tuning):
    """How measured points are weighed."""

    near_m = 0.1
    """Smallest depth that is counted with, in metres."""


class Ownership:
    """Says which run a place belongs to.

    Args:
        runs: what their keyframes measured.
        poses: T_world_camera of each run's keyframes in the common world, float64 [K, 4, 4].
        voxel: edge of a place, metres.
        factor: of run `number` and world points float64 [n, 3] that it measured how much each counts, [n]; None: all
            count alike.
    """

    def __init__(
        self, runs: list[KnownRun], poses: list[np.ndarray], voxel: float,
        factor: Callable[[int, np.ndarray], np.ndarray] | None = None,
    ) -> None:  # fmt: skip
        keys, weights, owners = [np.zeros(0, np.int64)], [np.zeros(0)], [np.zeros(0, np.int64)]
        for number, (run, own) in enumerate(zip(runs, poses, strict=True)):
            world = [transform_points(points.astype(float), T) for points, T in zip(run.points, own, strict=True)]
            depths = np.concatenate([np.zeros(0), *(points[:, 2].astype(float) for points in run.points)])
            places = np.concatenate([np.zeros((0, 3)), *world])
            weight = 1 / np.maximum(depths, OwnershipTuning.near_m) ** 2  # pixels a square metre
            keys.append(voxel_keys(places, voxel))
            weights.append(weight if factor is None else weight * factor(number, places))
            owners.append(np.full(len(places), number))
        found, where = np.unique(np.concatenate(keys), return_inverse=True)
        index = where.reshape(-1) * len(runs) + np.concatenate(owners)
        measured = np.bincount(index, np.concatenate(weights), len(found) * len(runs)).reshape(-1, len(runs))
        self._owners = _smooth(found, measured).argmax(1)
        self._tree = cKDTree(voxel_centres(found, voxel)) if len(found) else None

    def of(self, points: np.ndarray) -> np.ndarray:
        """Number of the run that each place [n, 3] belongs to, int64 [n]: that of the nearest measured voxel."""
        if self._tree is None:
            return np.zeros(len(points), np.int64)
        return self._owners[self._tree.query(points)[1]]


def _smooth(keys: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Sums [n, R] over each voxel (ascending keys [n]) and its 26 neighbours."""
    out = np.zeros_like(values)
    for x, y, z in product((-1, 0, 1), repeat=3):
        wanted = keys + neighbour_step(x, y, z)
        at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        out += np.where((keys[at] == wanted)[:, None], values[at], 0) if len(keys) else 0
    return out
