# SPDX-License-Identifier: Apache-2.0
"""Estimates the size of a scene, and from it the voxels and range of depth for fusion.

Pixels are as far apart as the depth they see is large: outdoors neighbouring points no longer fall into neighbouring
voxels of a size made for rooms, and most of what is seen lies beyond the depth that is of use in a room.
"""

from __future__ import annotations

import math

import numpy as np

from ggslam.system.tuning import Tuning


class SceneSizeTuning(Tuning):
    """Usual sizes of scenes."""

    near_m = 1.0
    """Smallest median depth of a scene of usual size, in metres."""
    far_m = 4.0
    """Largest median depth of a scene of usual size, in metres."""
    max_room_scale = 1.5
    """Largest scale at which surfaces are fused as in a room: a median depth of 6 m."""
    reach_m = 10.0
    """Depth that is fused with voxels of 1 cm, in metres. It grows with the voxels..."""
    min_reach_m = 30.0
    """...from this much, in metres, for views through doors and along corridors."""


def scene_scale(depth: np.ndarray) -> float:
    """Size of a scene against a room's, from one depth image: see `scale_of_depth`. 1 without any depth.

    Args:
        depth: float [H, W], metres, 0 where unknown.
    """
    seen = depth[depth > 0]
    return scale_of_depth(float(np.median(seen))) if len(seen) else 1.0


def scale_of_depth(median: float) -> float:
    """Median depth over the nearest usual one (`near_m` to `far_m` of `SceneSizeTuning`), so 1 for usual scenes."""
    return median / min(max(median, SceneSizeTuning.near_m), SceneSizeTuning.far_m)


def voxel_times(scale: float) -> int:
    """How many times a room's voxels those of a surface are in a scene of this scale: a whole number, so that grids of
    several runs fit each other; 1 up to `SceneSizeTuning.max_room_scale`."""
    return 1 if scale <= SceneSizeTuning.max_room_scale else math.ceil(scale)


def surface_reach(times: float) -> float:
    """Metres up to which depth is fused into points whose voxels are so many times a room's. What is farther away shows
    itself in pixels many voxels apart, and takes more memory than all that is nearer."""
    return max(SceneSizeTuning.min_reach_m, SceneSizeTuning.reach_m * times)
