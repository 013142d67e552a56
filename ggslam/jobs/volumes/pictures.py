# SPDX-License-Identifier: Apache-2.0
"""Pictures of meshes and occupancy maps: from above into the room, its nearer walls left out, and from a camera."""

from __future__ import annotations

import math

import cv2
import numpy as np

from ggslam.reporting.cloud_pictures import CloudView, draw_cloud, view_along
from ggslam.reporting.mesh_pictures import MeshDrawing
from ggslam.reporting.pictures import side_by_side
from ggslam.scene.id_colors import id_palette
from ggslam.scene.origin import moved_pose
from ggslam.system.tuning import Tuning
from ggslam.volumes.mesh_parts import MeshParts
from ggslam.volumes.occupancy import OccupancyMap


class MeshPictureTuning(Tuning):
    """From where meshes are drawn, and how large."""

    width = 800
    """Width of a picture, in pixels."""
    height = 600
    """Height of a picture, in pixels."""
    elevation = math.radians(40)
    """Angle at which the camera looks down, in radians."""
    sample = 500_000
    """Most vertices of which it is decided where to look from."""


def from_above(poses: np.ndarray, points: np.ndarray, up: np.ndarray) -> CloudView:
    """A view from outside obliquely down upon points [N, 3], from behind where the cameras [n, 4, 4] mostly stood."""
    low, high = np.percentile(points, [2, 98], axis=0)
    middle = (low + high) / 2
    forward = poses[:, :3, 2].mean(0)
    forward = forward - (forward @ up) * up
    if np.linalg.norm(forward) < 0.05:  # they looked all around
        forward = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    forward /= np.linalg.norm(forward)
    direction = math.cos(MeshPictureTuning.elevation) * forward - math.sin(MeshPictureTuning.elevation) * up
    view = view_along(middle, direction, up, MeshPictureTuning.width, MeshPictureTuning.height)
    x, y, z = ((points[:: max(1, len(points) // 20_000)] - middle) @ view.T_world_camera[:3, :3]).T
    camera = view.camera
    tangents = 2 * np.maximum(np.abs(x) / camera.width, np.abs(y) / camera.height) * camera.fx
    back = float(np.percentile(tangents - z, 98))
    return view_along(middle - back * direction, direction, up, MeshPictureTuning.width, MeshPictureTuning.height)


def from_a_camera(poses: np.ndarray, up: np.ndarray) -> CloudView:
    """The view of the frame in the middle of the recording, from a step behind it."""
    pose = poses[len(poses) // 2]
    return view_along(
        pose[:3, 3] - 0.3 * pose[:3, 2], pose[:3, 2], up, MeshPictureTuning.width, MeshPictureTuning.height
    )


def mesh_picture(mesh: MeshParts, poses: np.ndarray, up: np.ndarray, by_object: bool = False) -> np.ndarray:
    """A mesh from a camera and from above, uint8 [H, W, 3], in its colours or those of its objects."""
    spread = mesh.sample(MeshPictureTuning.sample)[0]
    drawings = [MeshDrawing(view) for view in (from_a_camera(poses, up), from_above(poses, spread, up))]
    for part in (part.mesh for part in mesh):
        colors = id_palette()[part.labels] if by_object else part.colors
        for drawing in drawings:
            drawing.add(part.vertices, part.triangles, part.normals, colors)
    return side_by_side([drawing.picture for drawing in drawings])


def occupancy_picture(occupancy: OccupancyMap, poses: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The occupied voxels below the cameras' heads from above, coloured by height, uint8 [H, W, 3]."""
    centers = occupancy.occupied_centers()[0].astype(np.float64) - occupancy.origin
    if not len(centers):
        return np.full((MeshPictureTuning.height, MeshPictureTuning.width, 3), 255, np.uint8)
    poses, heights = moved_pose(poses, -occupancy.origin), centers @ up
    head = float(np.percentile(poses[:, :3, 3] @ up, 90)) + 0.3
    shown = heights < head  # no ceiling
    centers, heights = (centers[shown], heights[shown]) if shown.any() else (centers, heights)
    low, high = np.percentile(heights, [1, 99])
    level = np.clip((heights - low) / max(high - low, 1e-6), 0, 1)
    colors = cv2.applyColorMap((255 * level).astype(np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
    return draw_cloud(centers, colors, from_above(poses, centers, up), occupancy.resolution)
