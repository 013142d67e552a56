# SPDX-License-Identifier: Apache-2.0
"""How large a scene is, and what follows for the voxels and the range of depth that surfaces are fused with.

Pixels are as far apart as the depth they see is large: outdoors neighbouring points no longer fall into neighbouring
voxels of a size made for rooms, and most of what is seen lies beyond the depth that is of use in a room.
"""

from __future__ import annotations

import math

import numpy as np

NEAR_M, FAR_M = 1.0, 4.0
"""Median depths between which a scene is of the usual size."""
LARGEST_ROOM = 1.5
"""Scale up to which surfaces are fused as in a room: a median depth of 6 m."""
_REACH_M = 10.0
"""Depth that is fused into points with voxels of 1 cm, for each centimetre of their voxels..."""
_LEAST_REACH_M = 30.0
"""...and in rooms, where some views go through a door and along a corridor."""


def scene_scale(depth: np.ndarray) -> float:
    """Size of a scene against a room's, from one depth image: see `scale_of_depth`. 1 without any depth.

    Args:
        depth: float [H, W], metres, 0 where unknown.
    """
    seen = depth[depth > 0]
    return scale_of_depth(float(np.median(seen))) if len(seen) else 1.0


def scale_of_depth(median: float) -> float:
    """1 for a median depth from `NEAR_M` to `FAR_M` metres, else the median over the nearer of these."""
    return median / min(max(median, NEAR_M), FAR_M)


def voxel_times(scale: float) -> int:
    """How many times a room's voxels those of a surface are in a scene of this scale: a whole number, so that grids of
    several runs fit each other; 1 up to `LARGEST_ROOM`."""
    return 1 if scale <= LARGEST_ROOM else math.ceil(scale)


def surface_reach(times: float) -> float:
    """Metres up to which depth is fused into points whose voxels are so many times a room's. What is farther away shows
    itself in pixels many voxels apart, and takes more memory than all that is nearer."""
    return max(_LEAST_REACH_M, _REACH_M * times)
