# SPDX-License-Identifier: Apache-2.0
"""A laser scan as depth images to the six sides of a cube around the sensor, for maps that take depth images.

Points that are neighbours in azimuth and elevation are joined by triangles, which are drawn exactly: where the scanner
measured a plane, the images show that plane at every pixel. Long triangles and those that rays only graze are left out:
they lie between two surfaces more often than on one. On scans of generated rooms this is more accurate than integrating
signed distances along each point's ray, 0.7 instead of 2.3 mm (median, 64 rings, voxels of 5 cm), for a ray tells
nothing of the voxels between it and the next one.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from ggslam.abi.core import ScanFaceSettings
from ggslam.native.loader import NativeContext, load_library
from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning
from ggslam.volumes.occupancy_arrays import contiguous_points

FACES: Final = 6
"""Sides of a cube."""


class ScanFaceTuning(Tuning):
    """How points are joined."""

    min_incidence = 0.1
    """Least cosine between a triangle's normal and the ray to it."""
    pixels_per_column = 0.375
    """Pixels along an edge of an image, per direction of a turn: in an image's middle they are 0.85 directions wide."""
    size_range = (64, 1024)
    """Least and most pixels along an edge of an image."""
    column_range = (90, 4096)
    """Least and most directions of a turn."""
    sampled_points = 4000
    """Points whose neighbours tell how many directions a turn has."""
    upright_share = 0.125
    """Share that azimuth counts with against elevation when the nearest neighbour is looked for: it is to be on the
    same ring."""


@dataclass(frozen=True)
class ScanFaces:
    """The images of scans of one sensor.

    Attributes:
        columns: directions of a turn.
        camera: of each image; its view is 90 degrees wide.
        T_sensor_faces: float64 [6, 4, 4]; forward, left, backward, right, up and down of a sensor whose z axis is up.
    """

    columns: int
    camera: Camera
    T_sensor_faces: np.ndarray

    @staticmethod
    def of(points: np.ndarray) -> ScanFaces:
        """Those that suit the sensor of a scan [n, 3]."""
        t = ScanFaceTuning
        columns = int(np.clip(_columns(points), *t.column_range))
        size = int(np.clip(8 * round(t.pixels_per_column * columns / 8), *t.size_range))
        camera = Camera(size, size, size / 2, size / 2, (size - 1) / 2, (size - 1) / 2)
        return ScanFaces(columns, camera, _faces())

    def draw(
        self, points: np.ndarray, max_edge: float, nearest: float, farthest: float, context: NativeContext
    ) -> np.ndarray:
        """Depth of a scan, float32 [6, size, size], metres along each face's axis, 0: nothing was measured.

        Args:
            points: [n, 3], sensor's frame, metres; those not finite are left out.
            max_edge: longest edge of a triangle between points, metres.
            nearest, farthest: range of the points that are used, metres.
            context: threads to work on.
        """
        points, size = contiguous_points(points), self.camera.width
        settings = ScanFaceSettings(nearest, farthest, max_edge, ScanFaceTuning.min_incidence, self.columns, size)
        axes = np.ascontiguousarray(self.T_sensor_faces[:, :3, :3].transpose(0, 2, 1), np.float32)
        depth = np.empty((FACES, size, size), np.float32)
        load_library().ggslam_scan_faces(
            context.handle, ctypes.byref(settings), points.ctypes.data, len(points), axes.ctypes.data, FACES,
            depth.ctypes.data,
        )  # fmt: skip
        return depth


def _columns(points: np.ndarray) -> int:
    """How many directions a turn has: a turn over the median angle between neighbours on a ring."""
    points = np.asarray(points, np.float64)
    points = points[np.isfinite(points).all(1) & (points[:, :2] != 0).any(1)]
    if len(points) < 2:
        return ScanFaceTuning.column_range[0]
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    angles = np.stack([azimuth, elevation / ScanFaceTuning.upright_share], 1)
    step = max(1, len(points) // ScanFaceTuning.sampled_points)
    apart = cKDTree(angles).query(angles[::step], k=2)[0][:, 1]
    apart = apart[apart > 0]
    return round(2 * math.pi / float(np.median(apart))) if len(apart) else ScanFaceTuning.column_range[0]


def _faces() -> np.ndarray:
    """T_sensor_face [6, 4, 4]: columns right, down and forward."""
    forward = np.array([(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], float)
    up = np.array([(0, 0, 1)] * 4 + [(1, 0, 0)] * 2, float)
    T = np.tile(np.eye(4), (FACES, 1, 1))
    T[:, :3, :3] = np.stack([np.cross(-up, forward), -up, forward], 2)
    return T
