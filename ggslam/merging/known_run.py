# SPDX-License-Identifier: Apache-2.0
"""What merging knows of a run: where its keyframes were, what they measured, and what they looked like."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ggslam.loops.odometry import OdometryTree
from ggslam.loops.places import PlaceIndex
from ggslam.loops.pose_graph import SURE_INFORMATION, odometry_covariance
from ggslam.loops.settings import GraphSettings
from ggslam.loops.uncertainty import covariance_in_frame
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse
from ggslam.tracking.points import FramePoints
from ggslam.tracking.settings import DepthNoise, TrackerSettings
from ggslam.tracking.surface import MeasuredSurface

_THICKNESS = 0.01
"""Of a point's disc along its normal against along the surface: the tracker's planes."""


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
        return self.surface.poses

    def frame_points(self, number: int) -> FramePoints:
        """A keyframe's points as the alignment takes them; their shapes are discs."""
        points, normals = np.ascontiguousarray(self.points[number]), np.ascontiguousarray(self.normals[number])
        thin = 1 - _THICKNESS
        pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
        covariances = np.stack([(i == j) - thin * normals[:, i] * normals[:, j] for i, j in pairs], 1)
        sigma = self.noise.constant + self.noise.square * points[:, 2].astype(float) ** 2
        weights = (self.noise.sigma(1.0) / sigma) ** 2
        pixels = np.zeros((len(points), 2), np.int32)
        return FramePoints(points, normals, covariances.astype(np.float32), pixels, weights.astype(np.float32))


class Chain:
    """The keyframes of a run as a chain of odometry, and how unsure it makes their places to each other.

    Args:
        poses: T_world_camera, float64 [K, 4, 4].
        settings: how much odometry drifts.
    """

    def __init__(self, poses: np.ndarray, settings: GraphSettings) -> None:
        tree = OdometryTree.root()
        for before, T in enumerate(poses[1:]):
            motion = inverse(poses[before]) @ T
            tree.add(before, motion, odometry_covariance(motion, SURE_INFORMATION, settings))
        self.poses = poses
        self._from_first = np.array(tree.poses)
        self._gathered = np.array(tree.covariances)

    def covariance(self, i: np.ndarray | int, j: np.ndarray | int) -> np.ndarray:
        """Covariance [..., 6, 6] of the motion from keyframe i to j, left twist in frame i."""
        first, last = np.minimum(i, j), np.maximum(i, j)
        return covariance_in_frame(self._gathered[last] - self._gathered[first], inverse(self._from_first[i]))
