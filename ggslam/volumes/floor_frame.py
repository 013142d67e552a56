# SPDX-License-Identifier: Apache-2.0
"""The frame of the floor: z up, z = 0 on the floor, its origin below that of the map. ROS's tools want such a frame.

x is the map's x axis as far as it is horizontal; so a map whose first camera was held level has x to its right and y
where it looked.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ggslam.scene.poses import inverse, matrix_to_quaternion
from ggslam.system.atomic import write_text
from ggslam.system.tuning import Tuning
from ggslam.volumes.output_frame import OutputFrame
from ggslam.volumes.upright import Upright

FLOOR_FILE = "floor.yaml"


class FloorTuning(Tuning):
    """Where the floor is if none was seen."""

    below_cameras_m = 1.0
    """Distance below the lowest camera, in metres."""


def level_axes(up: np.ndarray) -> np.ndarray:
    """Rows are x, y and z of a level frame in the map's frame, float64 [3, 3], of the direction `up` [3].

    x is the map's x axis as far as it is horizontal; if `up` is almost that axis, its z axis.
    """
    z = np.asarray(up, np.float64) / np.linalg.norm(up)
    x = np.eye(3)[0 if abs(z[0]) < 0.9 else 2]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def floor_height(upright: Upright, poses: np.ndarray) -> float:
    """Height of the floor along `upright.up`, metres from the map's origin; without one, `FloorTuning.below_cameras_m`
    under the lowest of the cameras T_map_camera [N, 4, 4]."""
    if upright.floor is not None:
        return upright.floor
    return float((np.asarray(poses)[:, :3, 3] @ upright.up).min()) - FloorTuning.below_cameras_m


def floor_from_map(upright: Upright, poses: np.ndarray) -> np.ndarray:
    """T_floor_map, float64 [4, 4]; arguments as of `floor_height`."""
    T = np.eye(4)
    T[:3, :3] = level_axes(upright.up)
    T[2, 3] = -floor_height(upright, poses)
    return T


def static_transform(T_map_floor: np.ndarray) -> str:
    """The command that publishes a floor [4, 4] in ROS 2, as a frame `floor` below a frame `map`."""
    options = {**_numbers(T_map_floor), "frame-id": "map", "child-frame-id": "floor"}
    words = " ".join(f"--{name} {value}" for name, value in options.items())
    return f"ros2 run tf2_ros static_transform_publisher {words}"


def _numbers(T: np.ndarray) -> dict[str, str]:
    """Translation and quaternion by the names of ROS's options."""
    qw, qx, qy, qz = matrix_to_quaternion(T[:3, :3])
    values = (*T[:3, 3], qx, qy, qz, qw)
    return {name: _text(value) for name, value in zip(("x", "y", "z", "qx", "qy", "qz", "qw"), values, strict=True)}


def _text(value: float) -> str:
    return f"{round(float(value), 9) + 0.0:.9f}"  # no -0


def write_floor_file(path: Path, T_floor_map: np.ndarray, frame: OutputFrame, seen: bool) -> str:
    """Writes where the floor is in the map as YAML; returns the command that publishes it.

    Args:
        path: of the file.
        T_floor_map: float64 [4, 4].
        frame: of the files beside it.
        seen: whether a floor was seen, or z = 0 is a guess.

    Raises:
        RunFolderError: it cannot be written.
    """
    T_map_floor = inverse(T_floor_map)
    command, n = static_transform(T_map_floor), _numbers(T_map_floor)
    write_text(
        path,
        "# The floor's frame (z up, z = 0 on the floor) in the map's frame, metres: a point p of the floor's frame is\n"
        "# rotation * p + translation in the map's. T_floor_map, row by row, leads back.\n"
        f"# {command}\n"
        "frame_id: map\nchild_frame_id: floor\n"
        f"translation: {{x: {n['x']}, y: {n['y']}, z: {n['z']}}}\n"
        f"rotation: {{x: {n['qx']}, y: {n['qy']}, z: {n['qz']}, w: {n['qw']}}}\n"
        f"T_floor_map: [{', '.join(map(_text, T_floor_map.ravel()))}]\n"
        f"floor_was_seen: {str(seen).lower()}\nfiles_are_in: {frame.value}\n",
    )
    return command
