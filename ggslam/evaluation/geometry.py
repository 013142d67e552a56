# SPDX-License-Identifier: Apache-2.0
"""How well the geometry of two maps, or of a map and the truth, agrees.

`register_clouds` brings one cloud upon the other (point-to-plane ICP: Y. Chen and G. Medioni, "Object Modelling by
Registration of Multiple Range Images", 1992); `overlap` says how much of a cloud found its partner, in the terms of
Open3D's `evaluate_registration`: fitness and inlier RMSE. `score_cloud` measures a cloud against a reference as A.
Knapitsch et al., "Tanks and Temples", 2017, do: precision, recall, F1 at distances, and the mean distances both ways.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from ggslam.scene.poses import inverse, orthonormalized, se3_exp, transformed, turning_angle

THRESHOLDS_M = (0.01, 0.02, 0.05)
FEWEST_MATCHES = 10
"""Fewer pairs of points than this leave a pose open."""
SMALL_STEP = 3e-5
"""Metres and radians: ICP ends at a smaller step."""
NEIGHBOURS = 16
"""Points from which a normal is estimated, the point itself included."""
MOST_QUERIES = 500_000
"""Of larger clouds a random sample of this many points is looked up, always among all points of the other."""
_CHUNK = 100_000


class Cloud:
    """Points with a search tree, for use in several of the functions here; they take bare arrays just as well.

    Args:
        points: [N, 3] metres, N > 0.

    Raises:
        ValueError: no points, or one that is not finite.
    """

    def __init__(self, points: np.ndarray) -> None:
        points = np.asarray(points, np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or not len(points):
            raise ValueError(f"expected points [N, 3], found an array of shape {points.shape}")
        if not np.isfinite(points).all():
            raise ValueError(f"point {int(np.argmin(np.isfinite(points).all(1)))} is not finite")
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


Points = np.ndarray | Cloud


@dataclass(frozen=True)
class CloudOverlap:
    """How one cloud lies upon another.

    Attributes:
        fitness: share of the source's points that have a point of the target within the greatest distance.
        inlier_rmse_m: root mean square distance of these pairs, point to point; 0 without any.
    """

    fitness: float
    inlier_rmse_m: float


@dataclass(frozen=True)
class CloudRegistration:
    """Result of ICP.

    Attributes:
        T_target_source: float64 [4, 4].
        overlap: of the moved source upon the target, over all points.
        moved_m, turned_deg: size of the motion from the start to the result, `moved_m` at the middle of the source.
        iterations: made at all distances together.
        converged: whether the last distance ended by a small step.
    """

    T_target_source: np.ndarray
    overlap: CloudOverlap
    moved_m: float
    turned_deg: float
    iterations: int
    converged: bool


@dataclass(frozen=True)
class ThresholdScore:
    """At one distance: share of the estimate near the reference, of the reference near the estimate, harmonic mean."""

    threshold_m: float
    precision: float
    recall: float
    f1: float


@dataclass(frozen=True)
class CloudScores:
    """A cloud against a reference.

    Attributes:
        accuracy_m, accuracy_median_m: distance of the estimate's points to the nearest of the reference.
        completeness_m, completeness_median_m: distance of the reference's points to the nearest of the estimate.
        thresholds: shares at several distances.
        normal_consistency: mean absolute cosine between the normals of nearest points, both ways; None without normals.
    """

    accuracy_m: float
    accuracy_median_m: float
    completeness_m: float
    completeness_median_m: float
    thresholds: tuple[ThresholdScore, ...]
    normal_consistency: float | None = None


def estimate_normals(points: Points, rows: np.ndarray | None = None, neighbours: int = NEIGHBOURS) -> np.ndarray:
    """Unit normals float64 [n, 3] of points [N, 3], from the plane through each point's nearest neighbours; their sign
    is arbitrary.

    Args:
        points: the cloud.
        rows: int [n], the points whose normals are wanted; None: all.
        neighbours: points in a plane, the point itself included.
    """
    cloud = _cloud(points)
    rows = np.arange(len(cloud)) if rows is None else rows
    normals = np.empty((len(rows), 3))
    for start in range(0, len(rows), _CHUNK):
        part = cloud.points[rows[start : start + _CHUNK]]
        _, near = cloud.tree.query(part, k=range(1, min(neighbours, len(cloud)) + 1), workers=-1)
        offset = cloud.points[near] - part[:, None]
        offset -= offset.mean(1, keepdims=True)
        normals[start : start + _CHUNK] = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))[1][:, :, 0]
    return normals


def overlap(
    source: Points, target: Points, max_distance: float = 0.05, T_target_source: np.ndarray | None = None, seed: int = 0
) -> CloudOverlap:
    """Fitness and inlier RMSE of a source upon a target.

    Args:
        source, target: [N, 3] and [M, 3] metres.
        max_distance: metres up to which points are partners.
        T_target_source: [4, 4]; None: both are in one frame.
        seed: of the sample of a source of more than `MOST_QUERIES` points.

    Raises:
        ValueError: a cloud is empty or not finite, or the distance is not positive.
    """
    distance = _positive(max_distance)
    apart, _ = _nearest(_cloud(source), _cloud(target), T_target_source, seed, distance)
    inliers = apart[np.isfinite(apart)]
    rmse = float(np.sqrt(np.mean(inliers**2))) if len(inliers) else 0.0
    return CloudOverlap(len(inliers) / len(apart), rmse)


def register_clouds(
    source: Points, target: Points, target_normals: np.ndarray | None = None,
    max_distances: Sequence[float] = (0.25, 0.10, 0.05), T_start: np.ndarray | None = None, iterations: int = 30,
    sample: int = 50_000, seed: int = 0,
) -> CloudRegistration:  # fmt: skip
    """Finds the motion that brings a source upon a target.

    Args:
        source, target: [N, 3] and [M, 3] metres.
        target_normals: [M, 3]; None: estimated where they are needed.
        max_distances: pairs farther apart are no pairs; from the first to the last. The last counts for the overlap.
        T_start: T_target_source to begin with; None: the identity.
        iterations: at most, at each distance.
        sample: the source's points that steer the motion, drawn at random.
        seed: of the draw.

    Raises:
        ValueError: a cloud is empty or not finite, a distance is not positive, or fewer than 10 points have a partner
            at some iteration.
    """
    source, target = _cloud(source), _cloud(target)
    distances = [_positive(d) for d in max_distances]
    normals = _LazyNormals(target, target_normals)
    chosen = source.points[source.sample(sample, seed)]
    start = np.eye(4) if T_start is None else np.asarray(T_start, np.float64)
    T, made, converged = start, 0, False
    for distance in distances:
        converged = False
        for _ in range(iterations):
            step = _step(transformed(chosen, T), target, normals, distance)
            T = orthonormalized(se3_exp(step) @ T)
            made += 1
            if np.abs(step).max() < SMALL_STEP:
                converged = True
                break
    middle = source.points.mean(0, keepdims=True)
    return CloudRegistration(
        T_target_source=T,
        overlap=overlap(source, target, distances[-1], T, seed),
        moved_m=float(np.linalg.norm(transformed(middle, T) - transformed(middle, start))),
        turned_deg=float(np.degrees(turning_angle(start, T))),
        iterations=made,
        converged=converged,
    )


def score_cloud(
    estimate: Points, reference: Points, thresholds: Sequence[float] = THRESHOLDS_M,
    T_reference_estimate: np.ndarray | None = None, estimate_normals: np.ndarray | None = None,
    reference_normals: np.ndarray | None = None, seed: int = 0,
) -> CloudScores:  # fmt: skip
    """Scores a cloud [N, 3] against a reference [M, 3], metres.

    Args:
        estimate, reference: points.
        thresholds: distances in metres.
        T_reference_estimate: [4, 4]; None: both are in one frame.
        estimate_normals, reference_normals: unit normals of both ([N, 3], [M, 3]) for the normal consistency.
        seed: of the samples of clouds of more than `MOST_QUERIES` points.

    Raises:
        ValueError: a cloud is empty or not finite, or a threshold is not positive.
    """
    estimate, reference = _cloud(estimate), _cloud(reference)
    wanted = [_positive(t) for t in thresholds]
    T = np.eye(4) if T_reference_estimate is None else T_reference_estimate
    to_reference, nearest = _nearest(estimate, reference, T, seed)
    to_estimate, nearest_back = _nearest(reference, estimate, inverse(T), seed)
    consistency = None
    if estimate_normals is not None and reference_normals is not None:
        turned = estimate_normals @ T[:3, :3].T
        there = turned[estimate.sample(MOST_QUERIES, seed)] * reference_normals[nearest]
        back = reference_normals[reference.sample(MOST_QUERIES, seed)] * turned[nearest_back]
        consistency = float((np.abs(there.sum(1)).mean() + np.abs(back.sum(1)).mean()) / 2)
    return CloudScores(
        accuracy_m=float(to_reference.mean()),
        accuracy_median_m=float(np.median(to_reference)),
        completeness_m=float(to_estimate.mean()),
        completeness_median_m=float(np.median(to_estimate)),
        thresholds=tuple(_at(t, to_reference, to_estimate) for t in wanted),
        normal_consistency=consistency,
    )


class _LazyNormals:
    """Normals of a cloud, given, or estimated for those points that are asked for."""

    def __init__(self, cloud: Cloud, normals: np.ndarray | None) -> None:
        self._cloud = cloud
        self._normals = np.zeros_like(cloud.points) if normals is None else np.asarray(normals, np.float64)
        self._known = np.full(len(cloud), normals is not None)

    def of(self, rows: np.ndarray) -> np.ndarray:
        unknown = np.unique(rows[~self._known[rows]])
        self._normals[unknown] = estimate_normals(self._cloud, unknown)
        self._known[unknown] = True
        return self._normals[rows]


def _step(moved: np.ndarray, target: Cloud, normals: _LazyNormals, distance: float) -> np.ndarray:
    """Gauss-Newton step (translation, rotation) [6], applied from the left, of the point-to-plane distances."""
    apart, nearest = target.tree.query(moved, distance_upper_bound=distance, workers=-1)
    pairs = np.isfinite(apart)
    if pairs.sum() < FEWEST_MATCHES:
        raise ValueError(f"expected at least {FEWEST_MATCHES} points within {distance} m of the target, found "
                         f"{int(pairs.sum())} of {len(moved)}")  # fmt: skip
    p, q, n = moved[pairs], target.points[nearest[pairs]], normals.of(nearest[pairs])
    J = np.concatenate([n, np.cross(p, n)], 1)
    residual = ((p - q) * n).sum(1)
    return np.linalg.lstsq(J.T @ J, -J.T @ residual, rcond=1e-9)[0]  # directions that nothing holds stay as they are


def _nearest(
    source: Cloud, target: Cloud, T_target_source: np.ndarray | None, seed: int, distance: float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Distance [n] to the nearest point of the target and its row, of a sample of the source; infinite beyond
    `distance`."""
    points = source.points[source.sample(MOST_QUERIES, seed)]
    if T_target_source is not None:
        points = transformed(points, T_target_source)
    return target.tree.query(points, distance_upper_bound=distance, workers=-1)


def _at(threshold: float, to_reference: np.ndarray, to_estimate: np.ndarray) -> ThresholdScore:
    precision, recall = float((to_reference <= threshold).mean()), float((to_estimate <= threshold).mean())
    total = precision + recall
    return ThresholdScore(threshold, precision, recall, 2 * precision * recall / total if total else 0.0)


def _cloud(points: Points) -> Cloud:
    return points if isinstance(points, Cloud) else Cloud(points)


def _positive(distance: float) -> float:
    if not 0 < distance < np.inf:
        raise ValueError(f"expected a positive distance in metres, found {distance}")
    return float(distance)
