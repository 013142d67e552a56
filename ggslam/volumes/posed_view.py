# SPDX-License-Identifier: Apache-2.0
"""What a sensor saw, to be fused, and where it was seen from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.scene.poses import transform_points
from ggslam.system.tuning import Tuning
from ggslam.volumes.occupancy import OccupancyMap
from ggslam.volumes.scan_faces import ScanFaces
from ggslam.volumes.settings import TsdfSettings


class PosedScanTuning(Tuning):
    """How scans are fused."""

    color = 176
    """Grey of their surfaces."""


@dataclass(frozen=True)
class PosedView:
    """What a camera sees of a surface.

    Attributes:
        depth: float32 [H, W], metres; 0: none; +inf: the sensor found nothing.
        camera: of the images.
        T_world_camera: float64 [4, 4].
        color: uint8 [H, W, 3], or None.
        labels: uint16 [H, W], object ids, or None.
    """

    depth: np.ndarray
    camera: Camera
    T_world_camera: np.ndarray
    color: np.ndarray | None = None
    labels: np.ndarray | None = None

    @property
    def point_count(self) -> int:
        """Number of its pixels with depth."""
        return int(np.count_nonzero((self.depth > 0) & (self.depth < np.inf)))

    def points(self) -> np.ndarray:
        """Where its pixels with depth lie, float64 [n, 3], world frame."""
        seen = self.camera.back_project(self.depth)[(self.depth > 0) & np.isfinite(self.depth)]
        return transform_points(seen.astype(np.float64), self.T_world_camera)

    def images(self, settings: TsdfSettings, context: NativeContext) -> list[PosedView]:
        """What a TSDF of these settings fuses of it: itself."""
        return [self]

    def in_frame(self, T: np.ndarray) -> PosedView:
        """The same in another world, T_other_world [4, 4]."""
        return replace(self, T_world_camera=T @ self.T_world_camera)

    def insert_into(self, occupancy: OccupancyMap, free_depth: float) -> None:
        """Inserts it; pixels of +inf free space up to `free_depth` metres."""
        occupancy.insert_depth(self.depth, self.camera, self.T_world_camera, free_depth=free_depth)


@dataclass(frozen=True)
class PosedScan:
    """What a laser scanner sees.

    Attributes:
        points: float32 [n, 3], metres in the sensor's frame, z along the axis that it turns about.
        T_world_sensor: float64 [4, 4].
        faces: of scans of this sensor.
    """

    points: np.ndarray
    T_world_sensor: np.ndarray
    faces: ScanFaces

    @property
    def point_count(self) -> int:
        """Number of its points."""
        return len(self.points)

    def images(self, settings: TsdfSettings, context: NativeContext) -> list[PosedView]:
        """What a TSDF of these settings fuses of it: depth to the sides that it sees something of; see `scan_faces`.
        Triangles between points are as long as distances are stored, at most."""
        camera = self.faces.camera
        farthest = np.sqrt(3) * (settings.max_depth + settings.truncation)  # of a face's corner
        depth = self.faces.draw(self.points, settings.truncation, settings.min_depth, float(farthest), context)
        color = np.full((camera.height, camera.width, 3), PosedScanTuning.color, np.uint8)
        return [
            PosedView(image, camera, self.T_world_sensor @ T_sensor_face, color)
            for image, T_sensor_face in zip(depth, self.faces.T_sensor_faces, strict=True)
            if image.any()
        ]

    def in_frame(self, T: np.ndarray) -> PosedScan:
        """The same in another world, T_other_world [4, 4]."""
        return replace(self, T_world_sensor=T @ self.T_world_sensor)

    def insert_into(self, occupancy: OccupancyMap, free_depth: float) -> None:
        """Inserts all points, however far; a scan does not say where it found nothing."""
        points = transform_points(self.points.astype(np.float64), self.T_world_sensor)
        occupancy.insert(points, self.T_world_sensor[:3, 3])
