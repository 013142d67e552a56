# SPDX-License-Identifier: Apache-2.0
"""Covariance of rigid motions in the convention of the tracker.

The uncertainty of a transform T_a_b is that of the twist xi = (v, w), translation first, metres and radians, that
leads from the estimate to the truth from the left: T_true = exp(xi) T_a_b. Its axes and origin are those of frame a.
Seen from another frame c the same motion is Ad(T_c_a) xi. (T. Barfoot, P. Furgale, "Associating Uncertainty with
Three-Dimensional Poses for Use in Estimation Problems", T-RO 2014.)
"""

from __future__ import annotations

import numpy as np

from ggslam.scene.poses import inverse


def adjoint(T: np.ndarray) -> np.ndarray:
    """Ad(T_c_a), float64 [..., 6, 6], of transforms [..., 4, 4]: turns a twist (v, w) from frame a to frame c."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    cross = np.zeros_like(R)
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = -t[..., 2], t[..., 1], -t[..., 0]
    out[..., :3, 3:] = (cross - np.swapaxes(cross, -1, -2)) @ R
    return out


def covariance_in_frame(covariance: np.ndarray, T_c_a: np.ndarray) -> np.ndarray:
    """The covariance [..., 6, 6] of twists in frame a as one in frame c."""
    A = adjoint(T_c_a)
    return A @ covariance @ np.swapaxes(A, -1, -2)


def information_in_frame(information: np.ndarray, T_c_a: np.ndarray) -> np.ndarray:
    """The inverse covariance [..., 6, 6] of twists in frame a as one in frame c.

    With T_c_a = inverse(T_world_i) this makes of `AlignmentResult.information` (world axes about the world's origin)
    the information of the motion T_i_j between a keyframe i and the frame j that was aligned.
    """
    A = adjoint(inverse(T_c_a))
    return np.swapaxes(A, -1, -2) @ information @ A


def covariance_of(information: np.ndarray, added: np.ndarray) -> np.ndarray:
    """Covariance [6, 6] of an information [6, 6] that may leave directions open, plus a covariance `added` [6, 6].

    A direction of which nothing is known is uncertain by 10 m, 10 rad.
    """
    known = 0.5 * (information + information.T) + 0.01 * np.eye(6)
    covariance = np.linalg.inv(known) + added
    return 0.5 * (covariance + covariance.T)
