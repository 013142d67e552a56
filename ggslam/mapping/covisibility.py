# SPDX-License-Identifier: Apache-2.0
"""Which keyframes show the same surface as another one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ggslam.geometry.image_parts import coarse_grid
from ggslam.mapping.keyframe import Keyframe
from ggslam.sight.margin import Margin
from ggslam.sight.view import View
from ggslam.system.tuning import Tuning


class CovisibilityTuning(Tuning):
    """When two keyframes are covisible."""

    stride = 16
    """Distance, in rows and columns, between the pixels of which the surface is looked for."""
    least_shared = 0.3
    """Share of them whose surface the other keyframe has to show."""
    window = 8
    """Most keyframes that count as covisible with one."""


def covisible(keyframe: Keyframe, others: Sequence[Keyframe]) -> list[int]:
    """Numbers, ascending, of the keyframes that show most of a keyframe's surface, of those that show enough."""
    points = _surface(keyframe)
    shared = np.array([_share_on(points, other) for other in others])
    best = np.argsort(-shared, kind="stable")[: CovisibilityTuning.window]
    return sorted(others[k].index for k in best if shared[k] >= CovisibilityTuning.least_shared)


def _surface(keyframe: Keyframe) -> np.ndarray:
    """World points of a keyframe's pixels on a coarse grid that have depth, [n, 3]."""
    depth = keyframe.depth_m()
    points = View.of(depth, keyframe.camera, keyframe.T_world_camera, Margin.usual()).points()
    return points[(coarse_grid(depth.shape, CovisibilityTuning.stride) & (depth > 0)).reshape(-1)]


def _share_on(points: np.ndarray, keyframe: Keyframe) -> float:
    """Share of the points on surface that a keyframe shows; 0 of none."""
    depth = keyframe.depth_m()
    if not len(points) or not depth.size:  # those of an earlier map may have no images
        return 0.0
    view = View.of(depth, keyframe.camera, keyframe.T_world_camera, Margin.usual())
    return float(view.classify_points(points).same.mean())
