# SPDX-License-Identifier: Apache-2.0
"""Reading descriptions written as JSON, with what is wrong told in one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.sequences.recording import read_text
from ggslam.system.tuning import Tuning

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Turns a camera frame with y up and z backwards (OpenGL, Blender, ARKit) into one with y down and z forward."""


class FocalLimitTuning(Tuning):
    """Focal lengths outside of these limits are no pixels but shares of the width, or millimetres."""

    min_focal = 0.05
    """Shortest focal length, in longer sides of the image: it sees 84 degrees from the axis."""
    max_focal = 100.0
    """Longest focal length, in longer sides of the image: it sees half a degree in all."""


def read_object(path: Path) -> dict[str, Any]:
    """The JSON object of a file. Raises SequenceError if it is missing or none."""
    return parse_object(path, read_text(path))


def parse_object(name: object, text: str | bytes) -> dict[str, Any]:
    """The JSON object of a text; `name` is for errors. Raises SequenceError if it is none."""
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SequenceError(f"{name}: not JSON: {error}") from None
    if not isinstance(content, dict):
        raise SequenceError(f"{name}: expected a JSON object, found {type(content).__name__}")
    return content


def numbers_of(name: object, values: dict[str, Any], key: str, count: int | None = None) -> np.ndarray:
    """Entry `key` as float64 numbers, flattened; `count`: how many. Raises SequenceError if it is not so."""
    if key not in values:
        raise SequenceError(f"{name}: entry '{key}' is missing")
    try:
        numbers = np.asarray(values[key], float).reshape(-1)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if count is not None and numbers.size != count or not numbers.size:
        wanted = "numbers" if count is None else "a number" if count == 1 else f"{count} numbers"
        raise SequenceError(f"{name}: expected {wanted} for '{key}', found {str(values[key])[:60]!r}")
    return numbers


def number_of(name: object, values: dict[str, Any], key: str) -> float:
    """Entry `key` as a finite number. Raises SequenceError if it is none."""
    value = float(numbers_of(name, values, key, 1)[0])
    if not np.isfinite(value):
        raise SequenceError(f"{name}: expected a number for '{key}', found {value}")
    return value


def camera_of(name: object, width: float, height: float, fx: float, fy: float, cx: float, cy: float) -> Camera:
    """A camera; raises SequenceError, naming `name`, for impossible numbers."""
    try:
        camera = Camera(int(width), int(height), fx, fy, cx, cy)
    except ValueError as error:
        raise SequenceError(f"{name}: {error}") from None
    side = max(camera.width, camera.height)
    if not FocalLimitTuning.min_focal * side <= min(fx, fy) <= max(fx, fy) <= FocalLimitTuning.max_focal * side:
        raise SequenceError(
            f"{name}: impossible focal lengths fx {fx:g}, fy {fy:g} of an image of {camera.width}x{camera.height}: "
            f"expected pixels, {FocalLimitTuning.min_focal * side:g} to {FocalLimitTuning.max_focal * side:g}"
        )
    return camera


def check_intrinsics(name: object, fx: float, fy: float, cx: float, cy: float) -> None:
    """Raises SequenceError, naming `name`, for numbers that are those of no camera, whatever its image's size."""
    try:
        Camera(1, 1, fx, fy, cx, cy)
    except ValueError as error:
        raise SequenceError(f"{name}: {error}") from None
