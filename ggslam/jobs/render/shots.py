# SPDX-License-Identifier: Apache-2.0
"""A picture of a film to be: from where, by which camera, when."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ggslam.errors import ConfigError
from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning

Size = tuple[int, int]
"""(width, height) in pixels."""


class ShotTuning(Tuning):
    """Films that are not told otherwise."""

    fps = 30.0
    """Pictures a second."""
    max_shots = 100_000
    """Largest number of pictures of a film."""
    max_side = 8192
    """Largest width or height of a picture in pixels."""


@dataclass(frozen=True)
class Shot:
    """A picture of a film.

    Attributes:
        time: seconds since the film's start.
        T_world_camera: float64 [4, 4].
        camera: its size is the picture's.
        frame: number of the recorded frame at that time; None where nothing was recorded from there.
    """

    time: float
    T_world_camera: np.ndarray
    camera: Camera
    frame: int | None = None


def parse_size(text: str) -> Size:
    """(width, height) of "1280x720"; raises ConfigError."""
    parts = text.lower().replace("×", "x").split("x")
    if len(parts) == 2 and all(part.strip().isdecimal() for part in parts):
        width, height = int(parts[0]), int(parts[1])
        if min(width, height) >= 16 and max(width, height) <= ShotTuning.max_side:
            return width, height
    raise ConfigError(f"`size`: expected WIDTHxHEIGHT from 16x16 to 8192x8192, like 1280x720, found {text!r}")


def fill_size(camera: Camera, size: Size | None) -> Camera:
    """A camera of another size that sees as much of the view as fits: what it shows, `camera` shows, too.

    Args:
        camera: of the recording.
        size: None: the camera itself.
    """
    if size is None:
        return camera
    width, height = size
    scale = max(width / camera.width, height / camera.height)
    whole = camera.resize(math.ceil(camera.width * scale - 1e-9), math.ceil(camera.height * scale - 1e-9))
    left, top = (whole.width - width) // 2, (whole.height - height) // 2
    return Camera(width, height, whole.fx, whole.fy, whole.cx - left, whole.cy - top)


def look_at_pose(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """T_world_camera [4, 4] of a camera at `position` [3] whose axis meets `target` [3], the image's top to `up` [3].

    Raises:
        ConfigError: there is no such camera: both are one point, or `up` is along the axis.
    """
    forward = np.asarray(target, float) - position
    right = np.cross(forward, np.asarray(up, float))
    if not np.linalg.norm(forward) > 1e-9 or not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward):
        raise ConfigError(f"a camera at {np.round(position, 3).tolist()} cannot look at {np.round(target, 3).tolist()}")
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    T[:3, 3] = position
    return T


def film_times(length: float, fps: float, seconds: float | None) -> tuple[np.ndarray, np.ndarray]:
    """When the pictures of a film are shown, and at which times of the path they are taken, both float64 [n] from 0.

    Args:
        length: of the path in seconds.
        fps: pictures a second.
        seconds: that the film shall take; None: the path's own.

    Raises:
        ConfigError: rates or lengths that make no film.
    """
    count = picture_count(length if seconds is None else seconds, fps, whole=seconds is not None)
    shown = np.arange(count) / fps
    if seconds is None:
        return shown, shown
    return shown, length * np.arange(count) / max(1, count - 1)


def picture_count(seconds: float, fps: float, whole: bool) -> int:
    """Pictures of a film of `seconds`; `whole`: the last one is shown for its time, too, else it ends the path."""
    if not 0 < fps <= 240:
        raise ConfigError(f"`fps`: expected a number above 0 and at most 240, found {fps:g}")
    if not (seconds > 0 if whole else seconds >= 0) or not math.isfinite(seconds):
        raise ConfigError(f"`seconds`: expected a number above 0, found {seconds:g}")
    if seconds * fps > ShotTuning.max_shots:
        raise ConfigError(f"a film of {seconds:g} s at {fps:g} pictures a second has more than {ShotTuning.max_shots}")
    return max(1, round(seconds * fps)) if whole else math.floor(seconds * fps + 1e-6) + 1
