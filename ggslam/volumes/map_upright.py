# SPDX-License-Identifier: Apache-2.0
"""Which way is up in a map of Gaussians."""

from __future__ import annotations

import numpy as np

from ggslam.geometry.normals import estimate_normals, turn_toward
from ggslam.rendering.types import Gaussians
from ggslam.volumes.upright import Upright, estimate_up

_SAMPLED = 20_000
"""Gaussians that are looked at, about."""
_NEIGHBOURS = 64
_THICKNESS = 0.1
"""Most that a surface varies along its normal, as a share of its variance across. So many neighbours and this found up
of five generated and rendered rooms to 0.1 to 1.8 degrees; by the axes in which single Gaussians are thinnest, which
training leaves anywhere, two of them were 6 and 12 off."""
_FAINTEST = 0.0
"""Logit of the opacity of what belongs to a surface."""
_LEAST_SUPPORT = 0.05


def upright_of(gaussians: Gaussians, poses: np.ndarray) -> Upright:
    """Up and floor from the surfaces of a map: the planes that neighbouring Gaussians lie in.

    Args:
        gaussians: the map.
        poses: T_world_camera [N, 4, 4] of the frames.
    """
    opaque = gaussians.opacity_logits.numpy() > _FAINTEST
    points = gaussians.means.numpy()[opaque].astype(np.float64)
    rows = np.arange(0, len(points), max(1, len(points) // _SAMPLED))
    if len(points) <= _NEIGHBOURS:
        return estimate_up(poses, np.zeros((0, 3)), np.zeros((0, 3)))
    normals = estimate_normals(points, rows, _NEIGHBOURS, thickness=_THICKNESS)
    # A plane has no front; a camera saw it from the side where the cameras are.
    normals = turn_toward(normals, poses[:, :3, 3].mean(axis=0) - points[rows])
    return estimate_up(poses, points[rows], normals, _LEAST_SUPPORT)
