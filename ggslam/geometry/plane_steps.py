# SPDX-License-Identifier: Apache-2.0
"""A Gauss-Newton step that moves points onto a surface: along the normals of its planes, and weakly to partners."""

from __future__ import annotations

import numpy as np

from ggslam.scene.poses import inverse, se3_exp, skew


def plane_step(
    p: np.ndarray, q: np.ndarray, n: np.ndarray, reach: float, tangent: float, held: np.ndarray | None = None,
    free: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """The motion [4, 4] that brings points nearer to their partners.

    Args:
        p: the points [n, 3].
        q, n: their partners and normals there, [n, 3].
        reach: metres; pairs a quarter of it apart count half.
        tangent: weight of the distance along the surface against that off it.
        held: bool [n], pairs whose distance along the surface counts; None: all.
        free: twists [6, k] about the middle that the motion may take; None: all.
    """
    middle, off = p.mean(0), p - q
    plane = (off * n).sum(1)
    weight = 1 / (1 + (plane / (0.25 * reach)) ** 2)
    along = weight if held is None else weight * held
    arm = p - middle
    J = np.concatenate([n, _cross(arm, n)], 1)
    H, g = J.T @ (weight[:, None] * J), J.T @ (weight * plane)
    lever, weighted = skew(along @ arm), along[:, None] * arm
    H[:3, :3] += tangent * along.sum() * np.eye(3)
    H[:3, 3:] -= tangent * lever
    H[3:, :3] += tangent * lever
    H[3:, 3:] += tangent * ((weighted * arm).sum() * np.eye(3) - weighted.T @ arm)
    g += tangent * np.concatenate([along @ off, along @ _cross(arm, off)])
    H[np.diag_indices(6)] += 1e-9 * len(p)  # where nothing tells, nothing moves
    twist = -np.linalg.solve(H, g) if free is None else -free @ np.linalg.solve(free.T @ H @ free, free.T @ g)
    there = np.eye(4)
    there[:3, 3] = middle
    return there @ se3_exp(twist) @ inverse(there)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products of rows [n, 3]; NumPy's own takes many times as long for a few hundred."""
    return np.asarray(a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]])
