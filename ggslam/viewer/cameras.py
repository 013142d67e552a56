# SPDX-License-Identifier: Apache-2.0
"""Places to look at a map from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning


class CameraTuning(Tuning):
    """From where a map is shown."""

    top_margin = 1.15
    """Factor on the map's size that the view from the top shows."""
    headroom_m = 0.35
    """The view from the top leaves out ceilings: what is this much higher than the cameras, in metres."""
    look_ahead_m = 2.0
    """Distance of the point that a page's camera turns around in front of a recorded camera, in metres."""


@dataclass(frozen=True)
class Viewpoint:
    """A camera that looks at a point; all [3], metres, world frame. `near`: nearer things are left out, metres."""

    position: np.ndarray
    look_at: np.ndarray
    up: np.ndarray
    near: float = 0.01


def view_of_pose(T_world_camera: np.ndarray, distance: float) -> Viewpoint:
    """What a recorded camera saw, looking at what is `distance` metres before it."""
    position, forward = T_world_camera[:3, 3], T_world_camera[:3, 2]
    return Viewpoint(position, position + distance * forward, -T_world_camera[:3, 1])


def view_from_behind(T_world_camera: np.ndarray, distance: float) -> Viewpoint:
    """A recorded camera from behind and above, so that what is drawn of it is seen before what it saw `distance`
    metres before it."""
    ahead = view_of_pose(T_world_camera, distance)
    back, raised = -0.4 * distance * T_world_camera[:3, 2], 0.25 * distance * ahead.up
    return Viewpoint(ahead.position + back + raised, ahead.look_at, ahead.up)


def top_view(centers: np.ndarray, positions: np.ndarray, forward: np.ndarray, up: np.ndarray, fov: float) -> Viewpoint:
    """Straight down on a map.

    Args:
        centers: [N, 3], of the Gaussians; if there are none, the cameras' positions stand for them.
        positions: [K, 3], of the recording cameras.
        forward: [3], direction that will point up in the picture, if it is not parallel to `up`.
        up: [3], unit vector.
        fov: of the view along its shorter side, radians.
    """
    centers = centers if len(centers) else positions
    low, high = np.percentile(centers, [1, 99], axis=0)
    middle = (low + high) / 2
    size = float(np.linalg.norm((high - low) - ((high - low) @ up) * up))
    ceiling = float((positions @ up).max()) + CameraTuning.headroom_m
    cut = min(ceiling, float((centers @ up).max()))
    height = CameraTuning.top_margin * size / 2 / math.tan(fov / 2)
    position = middle + (cut + height - float(middle @ up)) * up
    level = forward - (forward @ up) * up
    if np.linalg.norm(level) < 1e-3:
        level = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    return Viewpoint(position, middle, level / np.linalg.norm(level), near=max(0.01, height))


def vertical_fov(camera: Camera) -> float:
    """Vertical field of view in radians."""
    return 2 * math.atan(camera.height / 2 / camera.fy)


def box_lines(center: np.ndarray, axes: np.ndarray, size: np.ndarray) -> np.ndarray:
    """The twelve edges of a box, float32 [12, 2, 3]; `axes` [3, 3] has its directions as rows, `size` [3] metres."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    pairs = [(i, j) for i in range(8) for j in range(i + 1, 8) if np.count_nonzero(signs[i] != signs[j]) == 1]
    corners = center + (signs * size) @ axes
    return corners[np.array(pairs)].astype(np.float32)


def best_view(
    boxes: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], poses: Sequence[np.ndarray], camera: Camera,
    near: float,
) -> Viewpoint:  # fmt: skip
    """From the one of the poses [4, 4] whose image shows most of boxes, as large as can be; looking at their middle.

    Args:
        boxes: center, axes and size, as of `box_lines`; at least one.
        poses: T_world_camera; at least one.
        camera: of all.
        near: of the view, metres.
    """
    corners = np.concatenate([box_lines(*box).reshape(-1, 3) for box in boxes]).astype(float)
    middle = corners.mean(0)

    def score(T: np.ndarray) -> float:
        x, y, z = ((corners - T[:3, 3]) @ T[:3, :3]).T
        ahead = np.where(z > near, z, np.inf)
        column, row = x / ahead * camera.fx + camera.cx, y / ahead * camera.fy + camera.cy
        shown = (z > near) & (column > 0) & (column < camera.width) & (row > 0) & (row < camera.height)
        return float(shown.mean() / max(near, np.linalg.norm(middle - T[:3, 3])))

    best = max(poses, key=score)
    return Viewpoint(best[:3, 3], middle, -best[:3, 1], near)
