# SPDX-License-Identifier: Apache-2.0
"""Pictures of coloured point clouds: each point a square as large as its voxel, the nearest one seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning


class CloudPictureTuning(Tuning):
    """How clouds are drawn."""

    background = 255
    """Grey of the background."""
    max_point = 24
    """Largest width of a point, in pixels."""
    near_share = 0.05
    """Points nearer to the camera than this share of the cloud's size are not drawn."""
    field_of_view = math.radians(50)
    """Field of view, in radians."""
    margin = 1.04
    """Factor on the cloud's box that leaves a margin around it."""


@dataclass(frozen=True)
class CloudView:
    """Where a cloud is looked at from; T_world_camera float64 [4, 4], OpenCV axes."""

    camera: Camera
    T_world_camera: np.ndarray


def view_of(points: np.ndarray, width: int = 960, height: int = 720) -> CloudView:
    """A view that shows a cloud [N, 3].

    A cloud around the origin is taken for the map of a run, whose world is the first camera: it is seen from there,
    a step back. Any other one is seen whole from outside, obliquely, with its direction of least extent upwards.
    """
    low, high = np.percentile(points, [1, 99], axis=0)
    size = float(np.linalg.norm(high - low)) or 1.0
    if (points.min(0) <= 0).all() and (points.max(0) >= 0).all() and high[2] > 0.5 * size:
        pose = np.eye(4)
        pose[2, 3] = -0.1 * size
        return CloudView(_camera(width, height), pose)
    return outside_view(points, np.eye(3)[int(np.argmin(high - low))], width, height)


def outside_view(points: np.ndarray, upwards: np.ndarray, width: int = 960, height: int = 720) -> CloudView:
    """A view of a whole cloud [N, 3] from outside, obliquely from above; `upwards` is a direction [3]."""
    low, high = np.percentile(points, [1, 99], axis=0)
    up = np.asarray(upwards, float) / np.linalg.norm(upwards)
    side = np.eye(3)[(int(np.argmax(np.abs(up))) + 1) % 3]
    side = side - (side @ up) * up
    side /= np.linalg.norm(side)
    direction = 1.2 * up + 0.4 * side + np.cross(up, side)
    direction /= np.linalg.norm(direction)
    view = view_along(np.zeros(3), -direction, up, width, height)
    pose, camera = view.T_world_camera, view.camera
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T - (low + high) / 2
    x, y, z = (corners @ pose[:3, :3]).T
    # As near as all corners of the cloud's box stay within the picture.
    wide, tall = np.abs(x) / width, np.abs(y) / height
    distance = (2 * CloudPictureTuning.margin * camera.fx * np.maximum(wide, tall) - z).max()
    pose[:3, 3] = (low + high) / 2 + direction * distance
    return CloudView(camera, pose)


def view_along(
    position: np.ndarray, forward: np.ndarray, up: np.ndarray, width: int = 960, height: int = 720
) -> CloudView:
    """A view from a position [3] in a direction [3] of any length, with `up` [3] upwards in the picture."""
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= max(float(np.linalg.norm(right)), 1e-9)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = position
    return CloudView(_camera(width, height), pose)


def _camera(width: int, height: int) -> Camera:
    focal = 0.5 * width / math.tan(CloudPictureTuning.field_of_view / 2)
    return Camera(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))


def draw_cloud(points: np.ndarray, colors: np.ndarray, view: CloudView, point_size: float) -> np.ndarray:
    """A picture, uint8 [H, W, 3], of points float [N, 3] with colours uint8 [N, 3]; white where there is none.

    Args:
        points, colors: the cloud.
        view: where from.
        point_size: edge of a point's square in units of the positions, usually the voxel size.
    """
    camera = view.camera
    T_camera_world = np.linalg.inv(view.T_world_camera)
    position = points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    nearest = CloudPictureTuning.near_share * float(np.linalg.norm(np.ptp(points, axis=0))) + 1e-9
    rows = np.flatnonzero(position[:, 2] > nearest)
    rows = rows[np.argsort(-position[rows, 2], kind="stable")]  # the nearest are drawn last
    x, y, z = position[rows].T
    # A square that is seen from its side or corner shows up to sqrt(3) times its edge.
    width = np.clip(np.ceil(1.3 * point_size * camera.fx / z), 1, CloudPictureTuning.max_point).astype(np.int32)
    left = np.rint(camera.fx * x / z + camera.cx).clip(-(1 << 20), 1 << 20).astype(np.int32) - (width - 1) // 2
    top = np.rint(camera.fy * y / z + camera.cy).clip(-(1 << 20), 1 << 20).astype(np.int32) - (width - 1) // 2
    picture = np.full((camera.height * camera.width, 3), CloudPictureTuning.background, np.uint8)
    depth, winner = np.full(len(picture), np.inf), np.empty(len(picture), np.int64)
    for down, across in np.ndindex(int(width.max(initial=0)), int(width.max(initial=0))):
        first = int(np.searchsorted(width, max(down, across) + 1))  # nearer points are drawn wider
        u, v = left[first:] + across, top[first:] + down
        seen = first + np.flatnonzero((u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height))
        pixel = v[seen - first] * camera.width + u[seen - first]
        winner[pixel] = seen  # where several fall on one pixel the last, nearest one stays
        visible = (winner[pixel] == seen) & (z[seen] < depth[pixel])
        pixel, seen = pixel[visible], seen[visible]
        depth[pixel] = z[seen]
        picture[pixel] = colors[rows[seen]]
    return picture.reshape(camera.height, camera.width, 3)


def contact_sheet(pictures: Sequence[np.ndarray], captions: Sequence[str], columns: int = 3) -> np.ndarray:
    """Pictures uint8 [H, W, 3] of one size in rows, each above its caption (ASCII); uint8 [H', W', 3]."""
    height, width = pictures[0].shape[:2]
    scale = max(0.45, width / 900)
    strip = round(36 * scale)
    rows = -(-len(pictures) // columns)
    columns = min(columns, len(pictures))
    sheet = np.full((rows * (height + strip), columns * width, 3), CloudPictureTuning.background, np.uint8)
    for number, (picture, caption) in enumerate(zip(pictures, captions, strict=True)):
        top, left = number // columns * (height + strip), number % columns * width
        sheet[top : top + height, left : left + width] = picture
        place = (left + round(8 * scale), top + height + round(25 * scale))
        cv2.putText(sheet, caption, place, cv2.FONT_HERSHEY_SIMPLEX, 0.8 * scale, (0, 0, 0), 1, cv2.LINE_AA)
    return sheet
