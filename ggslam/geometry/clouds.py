# SPDX-License-Identifier: Apache-2.0
"""Comparison of point clouds by nearest points.

`overlap` says how much of a cloud found its partner, in the terms of Open3D's `evaluate_registration`: fitness and
inlier RMSE.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from ggslam.errors import InputError
from ggslam.scene.poses import transform_points
from ggslam.system.tuning import Tuning


class CloudTuning(Tuning):
    """Comparison of point clouds."""

    max_queries = 500_000
    """Most points of a cloud that are looked up in another. Of a larger cloud, a random sample is."""


class Cloud:
    """Points with a search tree, for use in several of the functions here; they take bare arrays just as well.

    Args:
        points: [N, 3] metres, N > 0.

    Raises:
        InputError: no points, or one that is not finite.
    """

    def __init__(self, points: np.ndarray) -> None:
        points = np.asarray(points, np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or not len(points):
            raise InputError(f"expected points [N, 3], found an array of shape {points.shape}")
        if not np.isfinite(points).all():
            raise InputError(f"point {int(np.argmin(np.isfinite(points).all(1)))} is not finite")
        self.points = points

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def tree(self) -> cKDTree:
        """Built when first needed. Not balanced: twice as fast to build, as fast to ask."""
        return cKDTree(self.points, balanced_tree=False, compact_nodes=False)

    def sample(self, count: int, seed: int) -> np.ndarray:
        """Row numbers of all points, or of `count` drawn at random."""
        if len(self) <= count:
            return np.arange(len(self))
        return np.sort(np.random.default_rng(seed).choice(len(self), count, replace=False))

    def queries(self, seed: int) -> np.ndarray:
        """Row numbers of the points that are looked up in another cloud."""
        return self.sample(CloudTuning.max_queries, seed)


Points = np.ndarray | Cloud


@dataclass(frozen=True)
class Overlap:
    """How one cloud matches another.

    Attributes:
        fitness: share of the source's points that have a point of the target within the greatest distance.
        inlier_rmse_m: root mean square distance of these pairs, point to point; 0 without any.
    """

    fitness: float
    inlier_rmse_m: float


def overlap(
    source: Points, target: Points, max_distance: float = 0.05, T_target_source: np.ndarray | None = None, seed: int = 0
) -> Overlap:
    """Fitness and inlier RMSE of a source upon a target.

    Args:
        source, target: [N, 3] and [M, 3] metres.
        max_distance: metres up to which points are partners.
        T_target_source: [4, 4]; None: both are in one frame.
        seed: of the sample of a source of more than `CloudTuning.max_queries` points.

    Raises:
        InputError: a cloud is empty or not finite, or the distance is not positive.
    """
    distance = check_distance(max_distance)
    apart, _ = nearest_points(as_cloud(source), as_cloud(target), T_target_source, seed, distance)
    inliers = apart[np.isfinite(apart)]
    rmse = float(np.sqrt(np.mean(inliers**2))) if len(inliers) else 0.0
    return Overlap(len(inliers) / len(apart), rmse)


def nearest_points(
    source: Cloud, target: Cloud, T_target_source: np.ndarray | None, seed: int, distance: float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Distance [n] to the nearest point of the target and its row, of a sample of the source; infinite beyond
    `distance`."""
    points = source.points[source.queries(seed)]
    if T_target_source is not None:
        points = transform_points(points, T_target_source)
    return target.tree.query(points, distance_upper_bound=distance, workers=-1)


def as_cloud(points: Points) -> Cloud:
    """Bare points [N, 3] with a tree to come; a cloud as it is."""
    return points if isinstance(points, Cloud) else Cloud(points)


def check_distance(distance: float) -> float:
    """The distance, metres; raises InputError unless it is positive and finite."""
    if not 0 < distance < np.inf:
        raise InputError(f"expected a positive distance in metres, found {distance}")
    return float(distance)
