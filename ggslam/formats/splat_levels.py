# SPDX-License-Identifier: Apache-2.0
"""Levels of detail of a Gaussian map: fewer, larger Gaussians that look the same from farther away.

Neighbours are merged in pairs, those first that differ least: in the manner of Ward (1963), a pair costs what a
weighted variance grows by, of positions in units of the Gaussians' own size and of colours. The weight of a Gaussian
is the area that it hides. In a round each Gaussian is merged with one other at most, so that levels get coarser
everywhere. `scripts/benchmarks/bench_levels.py` compares this with other ways.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ggslam.formats.splat_columns import SplatColumns
from ggslam.scene.gaussian_map import SH_C0
from ggslam.scene.poses import matrix_to_quaternion, quaternion_to_matrix
from ggslam.system.tuning import Tuning


class LevelTuning(Tuning):
    """How Gaussians are merged to a coarser level."""

    neighbours = 8
    """Nearest Gaussians that one may be merged with."""
    color_weight = 10.0
    """Weight of a squared difference of colours (0 to 1), against one of positions in units of the pair's size."""
    rounds = 6
    """Rounds in which pairs are found for a halving."""
    spread = 1.6
    """Factor of the distance's share in the merged variance: with 1 gaps would show between Gaussians. Chosen by
    `scripts/benchmarks/bench_levels.py`."""
    max_opacity = 0.99
    """Largest opacity of a merged Gaussian."""
    min_variance = 1e-12
    """Smallest variance of a merged Gaussian, in square metres."""


def coarser(columns: SplatColumns, count: int) -> SplatColumns:
    """So many Gaussians that stand for all; the same ones if there are no more.

    Args:
        columns: Gaussians.
        count: wanted, at least 1.
    """
    while len(columns) > count:
        one, other, cost = _neighbours(columns)
        first, second = _cheapest_pairs(one, other, cost, len(columns))
        first, second = first[: len(columns) - count], second[: len(columns) - count]
        alone = np.ones(len(columns), bool)
        alone[first] = alone[second] = False
        groups = np.tile(np.arange(len(first)), 2)
        merged = merge(columns.take(np.concatenate([first, second])), groups)
        columns = SplatColumns.join([columns.take(np.flatnonzero(alone)), merged])
    return columns


def _neighbours(columns: SplatColumns) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of Gaussians near each other, each once, int64 [P] twice, and what it costs to merge them, float64 [P]."""
    count = len(columns)
    _, near = cKDTree(columns.means).query(columns.means, k=min(LevelTuning.neighbours + 1, count))
    own = np.repeat(np.arange(count), near.shape[1])
    low, high = np.minimum(own, near.reshape(-1)), np.maximum(own, near.reshape(-1))
    keys = np.unique((low * count + high)[low != high])
    one, other = keys // count, keys % count
    area = _area(columns.log_scales)
    weight = -np.expm1(-_optical_depth(columns.logits)) * area
    apart = np.square(columns.means[one].astype(np.float64) - columns.means[other]).sum(1) / (area[one] + area[other])
    color = np.square(SH_C0 * (columns.sh[one, 0].astype(np.float64) - columns.sh[other, 0])).sum(1)
    cost = weight[one] * weight[other] / (weight[one] + weight[other]) * (apart + LevelTuning.color_weight * color)
    return one, other, cost


def _cheapest_pairs(
    one: np.ndarray, other: np.ndarray, cost: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Some of the pairs, the cheapest first, in which none of `count` Gaussians is twice: pairs cheaper than all others
    of both, then likewise among the rest."""
    order = np.argsort(cost, kind="stable")
    one, other, rank = one[order], other[order], np.arange(len(order))
    free, chosen = np.ones(count, bool), []
    for _ in range(LevelTuning.rounds):
        still = free[one] & free[other]
        one, other, rank = one[still], other[still], rank[still]
        best = np.full(count, len(order))
        np.minimum.at(best, one, rank)
        np.minimum.at(best, other, rank)
        taken = (best[one] == rank) & (best[other] == rank)
        free[one[taken]] = free[other[taken]] = False
        chosen.append(np.stack([rank[taken], one[taken], other[taken]]))
    _, first, second = np.concatenate(chosen, 1)[:, np.argsort(np.concatenate([c[0] for c in chosen]), kind="stable")]
    return first, second


def merge(columns: SplatColumns, groups: np.ndarray) -> SplatColumns:
    """One Gaussian for each group, with the mean and covariance of all in it, a little wider; what each hides (its
    optical depth times its area) is its weight and is kept. An object id is that of the heaviest.

    Args:
        columns: Gaussians.
        groups: int64 [N], numbers from 0 without gaps.
    """
    order = np.argsort(groups, kind="stable")
    starts = np.flatnonzero(np.diff(groups[order], prepend=-1))
    sizes = np.diff(starts, append=len(order))
    ordered = columns.take(order)
    weight = _optical_depth(ordered.logits) * _area(ordered.log_scales)
    total = np.add.reduceat(weight, starts)
    share = weight / total.repeat(sizes)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(share.reshape(-1, *[1] * (values.ndim - 1)) * values, starts)

    means = mean(ordered.means.astype(np.float64))
    offsets = ordered.means - means.repeat(sizes, 0)
    spread = _covariances(ordered) + LevelTuning.spread * offsets[:, :, None] * offsets[:, None, :]
    variances, axes = np.linalg.eigh(mean(spread))
    log_scales = 0.5 * np.log(variances.clip(LevelTuning.min_variance))
    opacity = (-np.expm1(-total / _area(log_scales))).clip(1e-6, LevelTuning.max_opacity)
    heaviest = np.lexsort([-weight, groups[order]])[starts]
    return SplatColumns(
        means.astype(np.float32), log_scales.astype(np.float32), _quaternions(axes).astype(np.float32),
        np.log(opacity / (1 - opacity)).astype(np.float32), mean(ordered.sh.astype(np.float64)).astype(np.float32),
        ordered.object_id[heaviest],
    )  # fmt: skip


def _optical_depth(logits: np.ndarray) -> np.ndarray:
    """-log(1 - opacity), float64 [N], above zero."""
    return np.logaddexp(0, logits.astype(np.float64)).clip(1e-9)


def _area(log_scales: np.ndarray) -> np.ndarray:
    """Of the shadows of ellipsoids [N, 3], the mean over three directions, float64 [N], up to a factor."""
    s = np.exp(log_scales.astype(np.float64).clip(-30, 30))
    return s[:, 0] * s[:, 1] + s[:, 1] * s[:, 2] + s[:, 2] * s[:, 0]


def _covariances(columns: SplatColumns) -> np.ndarray:
    """Float64 [N, 3, 3]."""
    R = quaternion_to_matrix(columns.quaternions.astype(np.float64))
    return (R * np.exp(2 * columns.log_scales.astype(np.float64).clip(-30, 30))[:, None, :]) @ R.transpose(0, 2, 1)


def _quaternions(axes: np.ndarray) -> np.ndarray:
    """Of orthonormal axes [N, 3, 3] in columns, whatever their hand, wxyz [N, 4]."""
    right_handed = axes * np.where(np.linalg.det(axes) < 0, -1, 1)[:, None, None]
    return matrix_to_quaternion(right_handed)
