# SPDX-License-Identifier: Apache-2.0
"""Estimates which part of a frame earlier views can have shown. No more than that can match the map, even at the right
pose."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ggslam.features.orb import FeatureView
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse, transform_points
from ggslam.system.tuning import Tuning
from ggslam.tracking.points import FramePoints


class SeenBeforeTuning(Tuning):
    """Overlap with earlier views."""

    points = 600
    """Points of a frame that are tested."""


def share_seen_before(
    points: FramePoints, T_world_camera: np.ndarray, views: Sequence[FeatureView], camera: Camera
) -> float:
    """Share of a frame's points that lie, at a pose [4, 4], where any of some earlier views has depth."""
    chosen = points.points[:: max(1, len(points) // SeenBeforeTuning.points)].astype(float)
    seen = np.zeros(len(chosen), bool)
    for view in views:
        there = transform_points(chosen, inverse(view.T_world_camera) @ T_world_camera)
        rows, columns, inside = camera.project(there)
        seen |= inside & (view.depth[rows, columns] > 0)
    return float(seen.mean()) if len(seen) else 0.0
