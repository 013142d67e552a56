# SPDX-License-Identifier: Apache-2.0
"""A run as merging sees it: poses, measurements and looks of its keyframes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ggslam.loops.places import PlaceIndex
from ggslam.scene.camera import Camera
from ggslam.tracking.points import FramePoints, disc_points
from ggslam.tracking.settings import DepthNoise, TrackerSettings
from ggslam.tracking.surface import MeasuredSurface


@dataclass
class KnownRun:
    """A finished run.

    Attributes:
        name: for people.
        cameras: of the images of each keyframe.
        tracking: settings of its tracker, fitted to the size of its scene.
        noise: of its depth camera.
        scale: size of its scene against a room's.
        surface: what its keyframes measured; its poses are those of the tracker, closed loops included.
        points, normals: the same, float32 [n, 3] of each keyframe in its camera's frame.
        places: what its keyframes looked like.
        keyframe_poses: as the mapper refined them, T_world_camera, float64 [K, 4, 4].
        closures: pairs of keyframes, older and newer, at which it closed a loop.
    """

    name: str
    cameras: list[Camera]
    tracking: TrackerSettings
    noise: DepthNoise
    scale: float
    surface: MeasuredSurface
    points: list[np.ndarray]
    normals: list[np.ndarray]
    places: PlaceIndex
    keyframe_poses: np.ndarray
    closures: list[tuple[int, int]] = field(default_factory=list)

    def __len__(self) -> int:
        """Number of keyframes."""
        return len(self.surface)

    @property
    def poses(self) -> np.ndarray:
        """T_world_camera of the keyframes as tracked, float64 [K, 4, 4]."""
        return self.surface.poses.array()

    def frame_points(self, number: int) -> FramePoints:
        """A keyframe's points as the alignment takes them; their shapes are discs."""
        return disc_points(self.points[number], self.normals[number], self.noise)
