# SPDX-License-Identifier: Apache-2.0
"""How far points of a map lie from a surface, and how much of the surface they cover."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ggslam.evaluation.geometry import ThresholdScore, threshold_score
from ggslam.geometry.clouds import Points, as_cloud, nearest_points
from ggslam.system.tuning import Tuning


class SurfaceScoreTuning(Tuning):
    """What surfaces are scored at."""

    thresholds_m = (0.01, 0.02)
    """Distances of the F-score, in metres."""


@dataclass(frozen=True)
class SurfaceScores:
    """Points against a surface.

    Attributes:
        median_m, p95_m: distance of the points from the surface, metres: half of them, 95 % of them are nearer.
        thresholds: precision, recall and F1 at 1 and 2 cm.
        points: how many were scored.
    """

    median_m: float
    p95_m: float
    thresholds: tuple[ThresholdScore, ...]
    points: int


def score_surface(points: Points, surface: Points, normals: np.ndarray, spacing: float, seed: int = 0) -> SurfaceScores:
    """Scores points [N, 3] against samples of a surface [M, 3] with unit normals [M, 3], metres.

    A point's distance is that to the tangent plane of the nearest sample, as long as it lies beside that sample by no
    more than the samples' spacing; else, beyond the border of the surface, that to the sample. So the distance of
    samples from one another does not count. How much is covered is told by the distance of each sample to the nearest
    point.

    Args:
        points: that are scored.
        surface: samples of the surface.
        normals: of the samples.
        spacing: of the samples, metres.
        seed: of the draws from more than `clouds.MOST_QUERIES` points.

    Raises:
        InputError: a cloud is empty or not finite.
    """
    points, surface = as_cloud(points), as_cloud(surface)
    straight, nearest = nearest_points(points, surface, None, seed)
    apart = points.points[points.queries(seed)] - surface.points[nearest]
    off = np.abs((apart * normals[nearest]).sum(1))
    beside = np.sqrt(np.maximum(straight**2 - off**2, 0))
    distance = np.where(beside <= spacing, off, straight)
    back, _ = nearest_points(surface, points, None, seed)
    return SurfaceScores(
        float(np.median(distance)), float(np.quantile(distance, 0.95)),
        tuple(threshold_score(t, distance, back) for t in SurfaceScoreTuning.thresholds_m), len(points),
    )  # fmt: skip
