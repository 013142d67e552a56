# SPDX-License-Identifier: Apache-2.0
"""How large a scene is, and the tracker's settings for it.

Pixels are as far apart as the depth they see is large: in a hall neighbouring points no longer fall into neighbouring
voxels of a size made for rooms, and most of what is seen lies beyond the depth that is of use in a room.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ggslam.tracking.settings import TrackerSettings

NEAR_M, FAR_M = 1.0, 4.0
"""Median depths between which a scene is of the usual size."""


def scene_scale(depth: np.ndarray) -> float:
    """Size of a scene against a room's, from one depth image: 1 where the median depth is from `NEAR_M` to `FAR_M`,
    else the median over the nearer of these. 1 without any depth.

    Args:
        depth: float [H, W], metres, 0 where unknown.
    """
    seen = depth[depth > 0]
    if not len(seen):
        return 1.0
    median = float(np.median(seen))
    return median / min(max(median, NEAR_M), FAR_M)


def scale_settings(settings: TrackerSettings, scale: float) -> TrackerSettings:
    """The settings with the target's voxels and, in scenes larger than rooms, the depth range times `scale`. Lengths
    that follow the depth noise are left alone."""
    points = replace(settings.points, max_depth=settings.points.max_depth * max(1.0, scale))
    return replace(settings, points=points, target=replace(settings.target, voxel=settings.target.voxel * scale))
