# SPDX-License-Identifier: Apache-2.0
"""How well the geometry of a map agrees with a reference: precision, recall, F1 at distances, and the mean distances
both ways, as A. Knapitsch et al., "Tanks and Temples", 2017, measure them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ggslam.geometry.clouds import Points, as_cloud, check_distance, nearest_points
from ggslam.scene.poses import inverse
from ggslam.system.tuning import Tuning


class GeometryScoreTuning(Tuning):
    """What geometry is scored at."""

    thresholds_m = (0.01, 0.02, 0.05)
    """Distances of the F-score, in metres."""


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


def score_cloud(
    estimate: Points, reference: Points, thresholds: Sequence[float] = GeometryScoreTuning.thresholds_m,
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
    estimate, reference = as_cloud(estimate), as_cloud(reference)
    wanted = [check_distance(t) for t in thresholds]
    T = np.eye(4) if T_reference_estimate is None else T_reference_estimate
    to_reference, nearest = nearest_points(estimate, reference, T, seed)
    to_estimate, nearest_back = nearest_points(reference, estimate, inverse(T), seed)
    consistency = None
    if estimate_normals is not None and reference_normals is not None:
        turned = estimate_normals @ T[:3, :3].T
        there = turned[estimate.queries(seed)] * reference_normals[nearest]
        back = reference_normals[reference.queries(seed)] * turned[nearest_back]
        consistency = float((np.abs(there.sum(1)).mean() + np.abs(back.sum(1)).mean()) / 2)
    return CloudScores(
        accuracy_m=float(to_reference.mean()),
        accuracy_median_m=float(np.median(to_reference)),
        completeness_m=float(to_estimate.mean()),
        completeness_median_m=float(np.median(to_estimate)),
        thresholds=tuple(threshold_score(t, to_reference, to_estimate) for t in wanted),
        normal_consistency=consistency,
    )


def threshold_score(threshold: float, to_reference: np.ndarray, to_estimate: np.ndarray) -> ThresholdScore:
    """Shares of distances [n] that are no larger: of the estimate to the reference, and back."""
    precision, recall = float((to_reference <= threshold).mean()), float((to_estimate <= threshold).mean())
    total = precision + recall
    return ThresholdScore(threshold, precision, recall, 2 * precision * recall / total if total else 0.0)
