# SPDX-License-Identifier: Apache-2.0
"""Levels of detail of a Gaussian map: fewer, larger Gaussians that look the same from farther away."""

from __future__ import annotations

import numpy as np

from ggslam.formats.splat_columns import SplatColumns
from ggslam.scene.poses import matrix_to_quaternion, quaternion_to_matrix

_MOST_OPAQUE = 0.99
_SEARCH_STEPS = 24
_LEAST_VARIANCE = 1e-12
"""Square metres."""


def coarser(columns: SplatColumns, count: int) -> SplatColumns:
    """At most so many Gaussians that stand for all: those in a voxel become one, of a size of voxels that fits.

    Args:
        columns: at least one Gaussian.
        count: wanted, at least 1.
    """
    if len(columns) <= count:
        return columns
    low = columns.means.min(0).astype(np.float64)
    small, large = 0.0, max(float((columns.means - low).max()), 1e-6) * 2
    groups = np.zeros(len(columns), np.int64)
    for _ in range(_SEARCH_STEPS):
        edge = (small + large) / 2
        tried = _voxels(columns.means - low, edge)
        if tried.max() < count:
            large, groups = edge, tried
            if tried.max() + 1 > 0.98 * count:
                break
        else:
            small = edge
    return merge(columns, groups)


def _voxels(offsets: np.ndarray, edge: float) -> np.ndarray:
    """Numbers from 0 of the voxels that points [N, 3] lie in, int64 [N]."""
    cells = np.floor(offsets / edge).astype(np.int64)
    sizes = cells.max(0) + 1
    keys = (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]
    return np.unique(keys, return_inverse=True)[1].reshape(-1)


def merge(columns: SplatColumns, groups: np.ndarray) -> SplatColumns:
    """One Gaussian for each group, with the mean and covariance of all in it; what each hides (its optical depth times
    its area) is its weight and is kept. An object id is that of the heaviest.

    Args:
        columns: Gaussians.
        groups: int64 [N], numbers from 0 without gaps.
    """
    count = int(groups.max()) + 1
    order = np.argsort(groups, kind="stable")
    starts = np.searchsorted(groups[order], np.arange(count))
    sizes = np.diff(starts, append=len(order))
    ordered = columns.take(order)
    area = _area(ordered.log_scales)
    weight = _optical_depth(ordered.logits) * area
    total = np.add.reduceat(weight, starts)
    share = weight / total.repeat(sizes)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(share.reshape(-1, *[1] * (values.ndim - 1)) * values, starts)

    means = mean(ordered.means.astype(np.float64))
    offsets = ordered.means - means.repeat(sizes, 0)
    spread = _covariances(ordered) + offsets[:, :, None] * offsets[:, None, :]
    variances, axes = np.linalg.eigh(mean(spread))
    log_scales = 0.5 * np.log(variances.clip(_LEAST_VARIANCE))
    opacity = (-np.expm1(-total / _area(log_scales))).clip(1e-6, _MOST_OPAQUE)
    heaviest = np.lexsort([-weight, groups[order]])[starts]
    merged = SplatColumns(
        means.astype(np.float32), log_scales.astype(np.float32), _quaternions(axes).astype(np.float32),
        np.log(opacity / (1 - opacity)).astype(np.float32), mean(ordered.sh.astype(np.float64)).astype(np.float32),
        ordered.object_id[heaviest],
    )  # fmt: skip
    alone = np.flatnonzero(sizes == 1)
    for name in ("log_scales", "quaternions", "logits"):
        getattr(merged, name)[alone] = getattr(ordered, name)[starts[alone]]
    return merged


def most_important(columns: SplatColumns, count: int) -> SplatColumns:
    """So many of the Gaussians, those that hide most, enlarged to hide together what all did."""
    if len(columns) <= count:
        return columns
    hidden = -np.expm1(-_optical_depth(columns.logits)) * _area(columns.log_scales)
    kept = np.sort(np.argpartition(-hidden, count)[:count])
    out = columns.take(kept)
    out.log_scales += np.float32(0.5 * np.log(hidden.sum() / hidden[kept].sum()))
    return out


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
