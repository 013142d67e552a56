# SPDX-License-Identifier: Apache-2.0
"""Topics that a map is published on, and frames of its tree."""

from __future__ import annotations

from enum import Enum
from typing import Final

import numpy as np

from ggslam.messages.contents import (
    Channel,
    Grid,
    Lens,
    Mesh,
    Path,
    Picture,
    Points,
    Pose,
    Splats,
    Things,
    Transforms,
    Verdicts,
)

MAP: Final = "map"
"""The frame of the run: its first camera's axes (x right, y down, z forward), as in trajectory.txt."""
FLOOR: Final = "floor"
"""z up, z = 0 on the floor; hangs fixed below `MAP`, as floor.yaml of `ggslam volumes` says."""
ODOM: Final = "odom"
"""In which the camera moves without a jump (REP 105)."""
CAMERA: Final = "camera"
"""The camera as a body (REP 103): x forward, y left, z up."""
OPTICAL: Final = "camera_optical"
"""The camera as its images see: x right, y down, z forward. Its pose in `MAP` is that of trajectory.txt."""
T_CAMERA_OPTICAL: Final = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])

TF = Channel("/tf", Transforms)
TF_STATIC = Channel("/tf_static", Transforms, latched=True)
POSE = Channel("ggslam/pose", Pose)
PATH = Channel("ggslam/path", Path, latched=True)
RECORDED = Channel("ggslam/image/recorded", Picture)
DEPTH = Channel("ggslam/image/depth", Picture)
RENDERED = Channel("ggslam/image/rendered", Picture)
LENS = Channel("ggslam/image/camera_info", Lens, latched=True)
POINTS = Channel("ggslam/points", Points, latched=True)
POINT_TILES = Channel("ggslam/points/tiles", Points)
SPLATS = Channel("ggslam/splats", Splats, latched=True)
SPLAT_TILES = Channel("ggslam/splats/tiles", Splats)
MESH = Channel("ggslam/mesh", Mesh, latched=True)
DISTANCE = Channel("ggslam/distance", Points, latched=True)
OBJECTS = Channel("ggslam/objects", Things, latched=True)
MOVERS = Channel("ggslam/movers", Things, latched=True)
CHANGES = Channel("ggslam/changes", Things, latched=True)
VERDICTS = Channel("/diagnostics", Verdicts)
CHANGED: Final = "changed"
"""Name of the part of a grid that is not as it was in the last whole one."""


def grid_channel(robot: str) -> Channel:
    """Of the floor as a robot meets it; without a name `grid`."""
    return Channel(f"ggslam/grid/{robot}" if robot else "ggslam/grid", Grid, latched=True)


class Flow(Enum):
    """Contents that share a budget."""

    small = "small"
    """Poses, frames, objects, verdicts: sent at once."""
    images = "images"
    map = "map"


def flow_of(channel: Channel) -> Flow:
    """The budget that a channel's contents count for."""
    if channel.kind is Picture:
        return Flow.images
    return Flow.map if channel.kind in (Path, Points, Splats, Mesh, Grid) else Flow.small
