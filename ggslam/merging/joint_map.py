# SPDX-License-Identifier: Apache-2.0
"""Joins maps of several runs: moves them into one world, equalises channels, appends them."""

from __future__ import annotations

import numpy as np
import torch

from ggslam.mapping.deformation import move_with_keyframes
from ggslam.scene.gaussian_map import GaussianMap


def move_map(gaussians: GaussianMap, T_new_old: np.ndarray) -> None:
    """Moves a run's Gaussians into another world, each with the keyframe that inserted it. Those of unknown birth go
    with the first keyframe.

    Args:
        gaussians: with `birth_keyframe` of the run.
        T_new_old: of each of its keyframes, float64 [K, 4, 4].
    """
    unknown = gaussians.birth_keyframe < 0
    gaussians.birth_keyframe[unknown] = 0
    move_with_keyframes(gaussians, T_new_old)
    gaussians.birth_keyframe[unknown] = -1


def with_channels(gaussians: GaussianMap, sh_degree: int, feature_channels: int) -> GaussianMap:
    """The same map with coefficients of a higher degree and feature channels, zero where it had none; itself if it
    has them."""
    if gaussians.sh_degree == sh_degree and gaussians.feature_channels == feature_channels:
        return gaussians
    out = GaussianMap(sh_degree, feature_channels, gaussians.device, gaussians.with_moments)
    g = gaussians
    rows = out.insert(g.means, g.quaternions, g.log_scales, g.opacity_logits, g.rgb, object_id=g.object_id)
    out.sh[rows, : g.sh.shape[1]] = g.sh
    out.features[rows, : g.features.shape[1]] = g.features
    for name in ("birth_keyframe", "updates", "feature_updates"):
        getattr(out, name)[rows] = getattr(g, name)
    if g.feature_channels:
        out.vote_ids[rows], out.vote_weights[rows] = g.vote_ids, g.vote_weights
    return out


def append_map(gaussians: GaussianMap, added: GaussianMap, first_keyframe: int) -> slice:
    """Puts a map with the same channels behind another one; its keyframes count from `first_keyframe` on."""
    rows = gaussians.append(added.take(torch.arange(len(added))))
    born = gaussians.birth_keyframe[rows]
    gaussians.birth_keyframe[rows] = torch.where(born >= 0, born + first_keyframe, born)
    return rows
