# SPDX-License-Identifier: Apache-2.0
"""Which directions of motion an alignment determines, and how well."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dsyevd

from ggslam.tracking.points import FramePoints
from ggslam.tracking.settings import DepthNoise

_SIX = np.eye(6)


def about_point(information: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Information of a twist about a centre turned into that of a twist about another point, [6, 6].

    A twist (v, w) about the point moves the centre, which lies at `centre` [3] from it, by v + w x centre; so
    v_centre = v - [centre]x w.
    """
    x, y, z = centre.tolist()
    A = _SIX.copy()
    A[0, 4], A[0, 5], A[1, 3], A[1, 5], A[2, 3], A[2, 4] = z, -y, -z, x, y, -x  # -[centre]x
    return A.T @ information @ A


@dataclass(frozen=True)
class PointSpread:
    """Where a frame's points lie, each weighed by the inverse variance of its depth.

    Attributes:
        total: sum of the weights, one per square metre; 0: there are no points.
        centroid: [3], camera frame, metres.
        radius: root mean square distance from it, metres.
    """

    total: float
    centroid: np.ndarray
    radius: float

    @classmethod
    def of(cls, source: FramePoints, noise: DepthNoise) -> PointSpread:
        """Of these points."""
        if not len(source):
            return cls(0.0, np.zeros(3), 0.0)
        z = source.z
        inverse_variance = 1.0 / (noise.constant + noise.square * z * z) ** 2
        total = float(inverse_variance.sum())
        centroid = inverse_variance @ source.points / total
        radius = float(np.sqrt(inverse_variance @ ((source.points - centroid) ** 2).sum(1) / total))
        return cls(total, centroid, radius)


def observability(
    information: np.ndarray, R_world_camera: np.ndarray, spread: PointSpread, limit: float
) -> tuple[np.ndarray, np.ndarray]:
    """How well each direction of motion is seen: eigenvalues [6], ascending, and the eigenvectors [k, 6] of those
    below `limit`.

    The information (about the camera centre) is taken about the points' centroid, where turning and shifting hardly
    mix; angles are measured by the motion they mean at the points' root mean square distance from it, and each
    point's information by its own noise. An eigenvalue is then the mean of (normal . motion)^2: the share of points
    that see the direction. Points that are no numbers see none.
    """
    numbers = (spread.total, spread.radius, *spread.centroid.tolist(), *information.ravel().tolist())
    if not spread.total or not all(map(math.isfinite, numbers)):
        return np.zeros(6), _SIX.copy()
    about = about_point(information, -R_world_camera @ spread.centroid)
    scale = np.array([1.0, 1.0, 1.0] + [1.0 / max(spread.radius, 1e-3)] * 3)
    # What np.linalg.eigh calls.
    values, vectors, failed = dsyevd(about * (scale[:, None] * scale) / spread.total, lower=1)
    if failed:
        raise np.linalg.LinAlgError("eigenvalues of an alignment's information do not converge")
    return values, vectors[:, values < limit].T
