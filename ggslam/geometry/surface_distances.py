# SPDX-License-Identifier: Apache-2.0
"""Measures the distance of points from the surface that a cloud samples: point to plane where the cloud has points
nearby.

Unlike the share of points with a partner within some distance, this does not improve when the rings of two laser scans
are laid upon one another instead of their walls, or what moved along with the sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.geometry.clouds import Cloud, Points, as_cloud
from ggslam.geometry.normals import estimate_normals
from ggslam.geometry.thinning import thinned_rows
from ggslam.scene.poses import transform_points
from ggslam.system.tuning import Tuning


class SurfaceDistanceTuning(Tuning):
    """Measurement of distances to a surface."""

    sample = 20_000
    """Most points that the spacing of a cloud is measured on."""


class LazyNormals:
    """Normals of a cloud, given [N, 3], or estimated for those points that are asked for."""

    def __init__(self, cloud: Cloud, normals: np.ndarray | None = None) -> None:
        self._cloud = cloud
        self._normals = np.zeros_like(cloud.points) if normals is None else np.asarray(normals, np.float64)
        self._known = np.full(len(cloud), normals is not None)

    def of(self, rows: np.ndarray) -> np.ndarray:
        """Unit normals [n, 3] of points by their rows [n]."""
        unknown = np.unique(rows[~self._known[rows]])
        self._normals[unknown] = estimate_normals(self._cloud.points, unknown, tree=self._cloud.tree)
        self._known[unknown] = True
        return self._normals[rows]


@dataclass(frozen=True)
class SurfaceDistances:
    """Of all points of a cloud, however far, to the surface of another.

    Attributes:
        median_m, p90_m: metres that half and 90 % of the points are nearer than.
    """

    median_m: float
    p90_m: float


def surface_distances(
    source: Points, target: Points, voxel: float, reach: float, T_target_source: np.ndarray | None = None,
    seed: int = 0, normals: LazyNormals | None = None,
) -> np.ndarray:  # fmt: skip
    """Distances, metres [n], of a source's points to a target's surface: to the plane at the nearest point if that is
    within `reach` metres and has a normal, else to that point. Of the source one point per voxel of `voxel` metres
    counts, and 20 000 in all.

    Raises:
        InputError: a cloud is empty or not finite.
    """
    source, target = as_cloud(source), as_cloud(target)
    points = source.points[thinned_rows(source.points, voxel)]
    points = points[Cloud(points).sample(SurfaceDistanceTuning.sample, seed)]
    moved = points if T_target_source is None else transform_points(points, T_target_source)
    apart, nearest = target.tree.query(moved, workers=-1)
    near = apart <= reach
    rows = nearest[near]
    n = (normals or LazyNormals(target)).of(rows)
    away = np.abs(((moved[near] - target.points[rows]) * n).sum(1))
    apart[near] = np.where(n.any(1), away, apart[near])
    return apart


def summary_of(distances: np.ndarray) -> SurfaceDistances:
    """Of distances [n] by `surface_distances`."""
    median, p90 = np.percentile(distances, [50, 90])
    return SurfaceDistances(float(median), float(p90))
