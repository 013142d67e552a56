# SPDX-License-Identifier: Apache-2.0
"""Pictures of changes: both maps from where they are seen best, with boxes around what changed."""

from __future__ import annotations

from itertools import product

import cv2
import numpy as np

from ggslam.changes.change import Change
from ggslam.changes.change_table import ChangeTable
from ggslam.changes.sightings import Visit
from ggslam.native.loader import NativeContext
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.reporting.pictures import color_to_uint8, side_by_side
from ggslam.scene.camera import Camera
from ggslam.scene.oriented_box import OrientedBox
from ggslam.scene.poses import inverse, transform_points
from ggslam.system.tuning import Tuning


class PictureTuning(Tuning):
    """How boxes are drawn around changes."""

    near_m = 0.1
    """Depth from which lines are drawn, in metres."""
    max_coordinate = 9999
    """Largest pixel coordinate that is given to OpenCV."""
    old_color = (220, 30, 30)
    """RGB of boxes where something was."""
    new_color = (20, 160, 60)
    """RGB of boxes where something is now."""


_EDGES = [(a, b) for a, b in product(range(8), repeat=2) if a < b and bin(a ^ b).count("1") == 1]


def picture_of_change(
    change: Change, table: ChangeTable, visits: tuple[Visit, Visit], context: NativeContext
) -> np.ndarray:
    """The older map beside the newer one, uint8 [H, W, 3]: red boxes around what was, green ones around what is."""
    camera, T_world_camera = _best_view(change, table, visits)
    T_camera_world, rasterizer, images = inverse(T_world_camera), CpuRasterizer(context=context), []
    for visit in visits:
        view = rasterizer.forward(visit.gaussians, camera, T_camera_world, features=False)
        picture = np.ascontiguousarray(color_to_uint8(view.image.numpy()))
        for number, color in ((0, PictureTuning.old_color), (1, PictureTuning.new_color)):
            box = table.box(change, number)
            if box is not None:
                _draw_box(picture, box, camera, T_camera_world, color)
        images.append(picture)
    return side_by_side(images)


def _best_view(change: Change, table: ChangeTable, visits: tuple[Visit, Visit]) -> tuple[Camera, np.ndarray]:
    """Camera and T_world_camera of the keyframe that shows most of what changed, in the middle and from near."""
    sides = [points for points in (table.points(change, 0), table.points(change, 1)) if len(points)]
    best, found = -1.0, (visits[0].cameras[0], visits[0].T_world_camera[0])
    for visit in visits:
        for camera, T in zip(visit.cameras, visit.T_world_camera, strict=True):
            score = min(_score(points, camera, T) for points in sides)
            if score > best:
                best, found = score, (camera, T)
    return found


def _score(points: np.ndarray, camera: Camera, T_world_camera: np.ndarray) -> float:
    x, y, z = transform_points(points, inverse(T_world_camera)).T
    ahead = np.where(z > PictureTuning.near_m, z, np.inf)
    column, row = x / ahead * camera.fx + camera.cx, y / ahead * camera.fy + camera.cy
    off = np.maximum(np.abs(2 * column / camera.width - 1), np.abs(2 * row / camera.height - 1))
    inside = (z > PictureTuning.near_m) & (off < 1)
    if not inside.any():
        return 0.0
    return float(inside.mean() * (1.2 - off[inside].mean()) / np.median(z[inside]))


def _draw_box(
    picture: np.ndarray, box: OrientedBox, camera: Camera, T_camera_world: np.ndarray, color: tuple[int, int, int]
) -> None:
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * np.array(box.size) @ np.array(box.axes)
    local = transform_points(corners + np.array(box.center), T_camera_world)
    for a, b in _EDGES:
        ends = local[[a, b]]
        if (ends[:, 2] < PictureTuning.near_m).any():
            continue
        pixels = ends[:, :2] / ends[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        start, end = (
            np.clip(np.rint(pixels), -PictureTuning.max_coordinate, PictureTuning.max_coordinate).astype(int).tolist()
        )
        cv2.line(picture, start, end, color, 1, cv2.LINE_AA)
