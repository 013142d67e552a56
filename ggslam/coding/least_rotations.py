# SPDX-License-Identifier: Apache-2.0
"""The 24 ways to name the axes of an ellipsoid: it is the same one with its scales permuted and its rotation turned by
quarters of a circle about its axes. Named so that the rotation is least, quaternions lie close together and take a
quarter fewer bytes."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np


def _axis_names() -> tuple[np.ndarray, np.ndarray]:
    """Quaternions float64 [24, 4] (w x y z) of the rotations that take axes to axes, and whose axis each axis becomes,
    int64 [24, 3]."""
    half = np.sqrt(0.5)
    found = [*np.eye(4), *(0.5 * np.array([1, *signs]) for signs in product((1, -1), repeat=3))]
    for a, b in permutations(range(4), 2):
        if a < b:
            found += [half * (np.eye(4)[a] + sign * np.eye(4)[b]) for sign in (1, -1)]
    turns = np.array(found)
    w, x, y, z = turns.T
    matrices = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]).transpose(2, 0, 1)  # fmt: skip
    return turns, np.abs(matrices).argmax(1)


_TURNS, _AXES = _axis_names()


def least_rotations(quaternions: np.ndarray, log_scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same ellipsoids with the least rotations.

    Args:
        quaternions: of unit length, w x y z, [N, 4].
        log_scales: [N, 3].

    Returns:
        Quaternions, w above 0.85, and scales, float64.
    """
    q = quaternions.astype(np.float64)
    conjugate = _TURNS * [1, -1, -1, -1]
    chosen = np.abs(q @ conjugate.T).argmax(1)  # w of the product q * turn is q . conjugate(turn)
    w, x, y, z = q.T
    a, b, c, d = _TURNS[chosen].T
    turned = np.stack([
        w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c, w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    ], 1)  # fmt: skip
    turned *= np.where(turned[:, :1] < 0, -1, 1)
    return turned, np.take_along_axis(log_scales.astype(np.float64), _AXES[chosen], 1)
