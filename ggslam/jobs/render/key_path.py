# SPDX-License-Identifier: Apache-2.0
"""A way through camera keys, which the page of `ggslam view` writes:

    {"fps": 30, "keys": [{"time": 0, "position": [x, y, z], "look_at": [x, y, z], "up": [x, y, z], "fov": 1.0}, ...]}

Positions and points that are looked at lie on centripetal Catmull-Rom curves (Barry and Goldman 1988), which pass
through the keys without loops: the knots between two keys are the square root of their distance apart, and time runs
evenly between them. Before the first key and after the last one a key is added by reflection. Up turns on a great
circle from key to key, `fov` (radians, along the shorter side as the page draws it) is interpolated linearly.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

import numpy as np
import pydantic

from ggslam.errors import ConfigError
from ggslam.jobs.render.shots import Shot, Size, film_times, look_at_pose
from ggslam.runs.records.annotations import CameraKeysRecord
from ggslam.runs.records.record import explain
from ggslam.scene.camera import Camera
from ggslam.system.untrusted_files import read_untrusted_text

DEFAULT_FOV: Final = 1.0
"""Radians along the shorter side, for keys that tell no angle of maps without a camera."""


def read_camera_keys(path: str | Path) -> CameraKeysRecord:
    """Reads a file of camera keys.

    Raises:
        ConfigError: it cannot be read or is no such file; says which key and what was expected.
    """
    text = read_untrusted_text(path, ConfigError)
    if text.lstrip().startswith("["):  # the keys alone, as the page keeps them beside the run
        text = f'{{"keys": {text}}}'
    try:
        found = CameraKeysRecord.model_validate_json(text)
    except pydantic.ValidationError as error:
        raise ConfigError(f"{path}: no camera keys: {explain(error).split(': ', 1)[-1]}") from None
    if not found.keys:
        raise ConfigError(f"{path}: no camera keys: keys: there are none")
    times = [key.time for key in found.keys]
    if any(later <= earlier for earlier, later in zip(times, times[1:], strict=False)):
        raise ConfigError(f"{path}: the times of the keys must rise, found {times}")
    return found


def key_shots(
    keys: CameraKeysRecord, fps: float | None = None, seconds: float | None = None, size: Size | None = None,
    fov: float = DEFAULT_FOV,
) -> list[Shot]:  # fmt: skip
    """A film through camera keys.

    Args:
        keys: at least one.
        fps: pictures a second; None: those of the keys.
        seconds: that the film shall take; None: from the first key to the last one as they say.
        size: of the pictures; None: 1280x720.
        fov: of keys that tell none, radians.

    Raises:
        ConfigError: numbers that make no film, or a camera that looks along its up direction.
    """
    times = np.array([key.time for key in keys.keys])
    shown, taken = film_times(float(times[-1] - times[0]), keys.fps if fps is None else fps, seconds)
    return [
        Shot(float(t), *view_at(keys, float(times[0] + at), size or (1280, 720), fov))
        for t, at in zip(shown, taken, strict=True)
    ]


def view_at(keys: CameraKeysRecord, time: float, size: Size, fov: float = DEFAULT_FOV) -> tuple[np.ndarray, Camera]:
    """T_world_camera [4, 4] and the camera at a time in seconds; before the first key and after the last, theirs."""
    times = np.array([key.time for key in keys.keys])
    segment = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, max(0, len(times) - 2)))
    last = min(segment + 1, len(times) - 1)
    share = 0.0 if last == segment else (time - times[segment]) / (times[last] - times[segment])
    share = float(np.clip(share, 0, 1))
    position = _curve(np.array([key.position for key in keys.keys]), segment, share)
    look_at = _curve(np.array([key.look_at for key in keys.keys]), segment, share)
    before, after = keys.keys[segment], keys.keys[last]
    up = _great_circle(np.array(before.up), np.array(after.up), share)
    T = look_at_pose(position, look_at, up)
    angles = [fov if key.fov is None else key.fov for key in (before, after)]
    return T, page_camera(size, angles[0] + (angles[1] - angles[0]) * share)


def page_camera(size: Size, fov: float) -> Camera:
    """The camera with which the page draws a canvas of `size`: `fov` in radians spans the height of wide ones."""
    width, height = size
    focal = min(height, width / 1.1) / 2 / math.tan(fov / 2)
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def page_fov(camera: Camera) -> float:
    """The angle with which the page shows what a camera sees, radians; the other way round than `page_camera`."""
    return 2 * math.atan(min(camera.height / camera.fy, camera.width / 1.1 / camera.fx) / 2)


def _curve(points: np.ndarray, segment: int, share: float) -> np.ndarray:
    """The point [3] at `share` in [0, 1] between points [n, 3] number `segment` and the next one."""
    if len(points) == 1:
        return points[0]
    points = np.concatenate([[2 * points[0] - points[1]], points, [2 * points[-1] - points[-2]]])
    p = points[segment : segment + 4]
    apart = np.sqrt(np.linalg.norm(np.diff(p, axis=0), axis=1))
    if apart[1] < 1e-9:
        return p[1]
    k = np.concatenate([[0.0], np.cumsum(np.where(apart < 1e-9, apart[1], apart))])
    t = k[1] + share * (k[2] - k[1])

    def between(a: np.ndarray, b: np.ndarray, low: float, high: float) -> np.ndarray:
        return a + (b - a) * (t - low) / (high - low)

    first, second, third = (between(p[i], p[i + 1], k[i], k[i + 1]) for i in range(3))
    return between(between(first, second, k[0], k[2]), between(second, third, k[1], k[3]), k[1], k[2])


def _great_circle(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    """The unit vector [3] at `share` of the way from `a` to `b`."""
    lengths = np.linalg.norm(a), np.linalg.norm(b)
    if min(lengths) < 1e-9:
        raise ConfigError("a camera key's up direction has no length")
    a, b = a / lengths[0], b / lengths[1]
    angle = math.acos(float(np.clip(a @ b, -1, 1)))
    if angle < 1e-6 or angle > math.pi - 1e-6:
        return a if share < 0.5 else b
    return (math.sin((1 - share) * angle) * a + math.sin(share * angle) * b) / math.sin(angle)
