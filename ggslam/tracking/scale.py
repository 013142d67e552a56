# SPDX-License-Identifier: Apache-2.0
"""The tracker's settings for a scene of another size than a room's; see `geometry.scene_size`."""

from __future__ import annotations

from dataclasses import replace

from ggslam.tracking.settings import TrackerSettings


def scale_settings(settings: TrackerSettings, scale: float) -> TrackerSettings:
    """The settings with the target's voxels and, in scenes larger than rooms, the depth range times `scale`. Lengths
    that follow the depth noise are left alone."""
    points = replace(settings.points, max_depth=settings.points.max_depth * max(1.0, scale))
    return replace(settings, points=points, target=replace(settings.target, voxel=settings.target.voxel * scale))
