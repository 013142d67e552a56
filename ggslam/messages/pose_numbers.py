# SPDX-License-Identifier: Apache-2.0
"""Poses as the seven numbers of messages."""

from __future__ import annotations

import numpy as np

from ggslam.scene.poses import matrix_to_quaternion


def position_and_quaternion(T: np.ndarray) -> np.ndarray:
    """x y z and the unit quaternion x y z w with w >= 0, float64 [..., 7], of poses [..., 4, 4]."""
    T = np.asarray(T, np.float64)
    wxyz = matrix_to_quaternion(T[..., :3, :3])
    wxyz = np.where(wxyz[..., :1] < 0, -wxyz, wxyz)
    return np.concatenate([T[..., :3, 3], wxyz[..., 1:], wxyz[..., :1]], -1)
