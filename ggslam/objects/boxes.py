# SPDX-License-Identifier: Apache-2.0
"""The middle of a set of points, and the box around it along its own axes."""

from __future__ import annotations

import numpy as np
from scipy.linalg import svd

from ggslam.scene.oriented_box import OrientedBox, Vector
from ggslam.system.tuning import Tuning


class BoxTuning(Tuning):
    """Which points a box holds."""

    trimmed = 0.01
    """Share of the points, the farthest from the middle, that a box need not hold: floaters would inflate it."""


def middle_of(points: np.ndarray, weights: np.ndarray) -> Vector:
    """Weighted mean of points [M, 3] without the farthest (`BoxTuning.trimmed`)."""
    kept = _inlier_mask(points)
    return _vector(np.average(points[kept].astype(np.float64), axis=0, weights=weights[kept].astype(np.float64)))


def oriented_box(points: np.ndarray) -> OrientedBox:
    """Box along the principal axes of points [M, 3], M >= 1, without the farthest (`BoxTuning.trimmed`). Fewer than
    three points
    leave axes undetermined: these are chosen along the coordinates."""
    inner = points[_inlier_mask(points)].astype(np.float64)
    axes = np.eye(3)
    if len(inner) >= 3:
        axes = svd(inner - inner.mean(0), full_matrices=False)[2]
    elif len(inner) == 2 and np.any(inner[1] != inner[0]):
        axes = np.linalg.qr(np.column_stack([inner[1] - inner[0], np.eye(3)]))[0].T
    # Signs are free: make each axis' largest part positive, and the three right-handed.
    axes = axes * np.sign(axes[np.arange(3), np.abs(axes).argmax(1)])[:, None]
    axes[2] *= np.sign(np.linalg.det(axes))
    along = inner @ axes.T
    low, high = along.min(0), along.max(0)
    first, second, third = map(_vector, axes)
    return OrientedBox(_vector((low + high) / 2 @ axes), (first, second, third), _vector(high - low))


def _inlier_mask(points: np.ndarray) -> np.ndarray:
    """bool [M]: all but the share `BoxTuning.trimmed` of points that are farthest from the median."""
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return distance <= np.quantile(distance, 1 - BoxTuning.trimmed, method="higher")


def _vector(values: np.ndarray) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
