# SPDX-License-Identifier: Apache-2.0
"""Moves each Gaussian rigidly with the keyframe that inserted it."""

from __future__ import annotations

import numpy as np
import torch

from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.harmonics import harmonic_rotations
from ggslam.scene.poses import left_multiplication, matrix_to_quaternion
from ggslam.system.tuning import Tuning


class DeformationTuning(Tuning):
    """How the map follows its keyframes."""

    block = 1 << 16
    """Gaussians moved in one batch, so that temporary arrays stay small."""


def move_with_keyframes(gaussians: GaussianMap, T_new_old: np.ndarray) -> None:
    """Moves Gaussians after their keyframes were corrected.

    Means and rotations move rigidly, and colours that depend on the viewing direction turn along. So do Adam's first
    moments, which are averages of gradients; of the second moments, averages of squared gradients, the diagonal is
    turned as if the components were uncorrelated.

    Args:
        gaussians: the map. Gaussians of unknown birth (-1) stay where they are.
        T_new_old: [K, 4, 4], for each keyframe what moves the world about it from the old to the new place.
    """
    birth = gaussians.birth_keyframe.long()
    R = torch.as_tensor(T_new_old[:, :3, :3], dtype=torch.float32).to(gaussians.device)
    t = torch.as_tensor(T_new_old[:, :3, 3], dtype=torch.float32).to(gaussians.device)
    quaternions = np.stack([matrix_to_quaternion(r) for r in T_new_old[:, :3, :3]])
    turn = torch.from_numpy(left_multiplication(quaternions).astype(np.float32)).to(gaussians.device)
    harmonics = _harmonic_turns(T_new_old, gaussians)
    moved = torch.as_tensor(np.abs(T_new_old - np.eye(4)).max((1, 2)) > 0).to(gaussians.device)
    rows = torch.nonzero((birth >= 0) & moved[birth.clamp(min=0)], as_tuple=True)[0]
    for block in rows.split(DeformationTuning.block):
        own = birth[block]
        gaussians.means[block] = _times(R[own], gaussians.means[block]) + t[own]
        gaussians.quaternions[block] = _times(turn[own], gaussians.quaternions[block])
        if gaussians.with_moments:
            for name, matrices in (("means", R[own]), ("quaternions", turn[own])):
                first, second = gaussians.moments[name]
                first[block] = _times(matrices, first[block])
                second[block] = _times(matrices**2, second[block])
        if harmonics is not None:
            _turn_colors(gaussians, block, harmonics[own])
    gaussians.version += 1


def _harmonic_turns(T_new_old: np.ndarray, gaussians: GaussianMap) -> torch.Tensor | None:
    """Matrices float32 [K, C, C] for the C colour coefficients of each keyframe's Gaussians; None: there is but one."""
    count = gaussians.sh.shape[1]
    if count == 1:
        return None
    return torch.from_numpy(harmonic_rotations(T_new_old[:, :3, :3], count).astype(np.float32)).to(gaussians.device)


def _turn_colors(gaussians: GaussianMap, rows: torch.Tensor, turns: torch.Tensor) -> None:
    """Turns the coefficients of rows [M], and their moments, by a matrix each, [M, C, C]."""
    gaussians.sh[rows] = turns @ gaussians.sh[rows]
    if gaussians.with_moments:
        first, second = gaussians.moments["sh"]
        first[rows] = turns @ first[rows]
        second[rows] = turns**2 @ second[rows]


def _times(matrices: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    return torch.einsum("nij,nj->ni", matrices, vectors)
