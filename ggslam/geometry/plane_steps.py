# SPDX-License-Identifier: Apache-2.0
"""A Gauss-Newton step that brings points upon a surface: off it by its planes, along it by their partners."""

from __future__ import annotations

import numpy as np

from ggslam.scene.poses import inverse, se3_exp


def plane_step(
    p: np.ndarray, q: np.ndarray, n: np.ndarray, reach: float, tangent: float, held: np.ndarray | None = None
) -> np.ndarray:
    """The motion [4, 4] that brings points nearer to their partners.

    Args:
        p: the points [n, 3].
        q, n: their partners and normals there, [n, 3].
        reach: metres; pairs a quarter of it apart count half.
        tangent: weight of the distance along the surface against that off it.
        held: bool [n], pairs whose distance along the surface counts; None: all.
    """
    middle, off = p.mean(0), p - q
    plane = (off * n).sum(1)
    weight = 1 / (1 + (plane / (0.25 * reach)) ** 2)
    along = weight if held is None else weight * held
    arm = p - middle
    J = np.concatenate([n, np.cross(arm, n)], 1)
    H, g = J.T @ (weight[:, None] * J), J.T @ (weight * plane)
    for axis in np.eye(3):
        J = np.concatenate([np.broadcast_to(axis, p.shape), np.cross(arm, axis)], 1)
        H += tangent * J.T @ (along[:, None] * J)
        g += tangent * J.T @ (along * (off @ axis))
    H[np.diag_indices(6)] += 1e-9 * len(p)  # where nothing tells, nothing moves
    twist = -np.linalg.solve(H, g)
    there = np.eye(4)
    there[:3, 3] = middle
    return there @ se3_exp(twist) @ inverse(there)
