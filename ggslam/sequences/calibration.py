# SPDX-License-Identifier: Apache-2.0
"""Calibrations: camera.yaml of a plain folder, and files for `--camera` and `--depth-camera`. Files of other programs
are translated into the same entries (`camera_files`).

    width: 640            size, focal lengths and principal point in pixels, as in `scene.camera.Camera`
    height: 480
    fx: 585.0
    fy: 585.0
    cx: 319.5
    cy: 239.5
    distortion: [...]     4, 5, 8, 12 or 14 coefficients in OpenCV's order; optional
    distortion_model: opencv | fisheye

A depth camera's calibration holds also

    T_color_depth: [16 numbers, row by row]   from its frame to the colour camera's, OpenCV axes, metres
    color: {width: ..., fx: ..., ...}         of the colour camera, if not as the recording says; optional
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.poses import is_valid_pose
from ggslam.sequences.camera_files.lens_models import distortion_of
from ggslam.sequences.camera_files.reading import read_entries
from ggslam.sequences.json_files import camera_of, check_intrinsics
from ggslam.sequences.recording import Calibration, DepthCamera, Recording
from ggslam.system.tuning import Tuning


class CalibrationTuning(Tuning):
    """Limits on numbers in calibrations."""

    max_number = 1e300
    """Largest absolute value of any number."""
    max_centre = 100.0
    """Largest coordinate of a principal point, in image sizes; crops have large ones."""


def read_calibration(path: Path) -> dict[str, Any]:
    """Entries of a file, whichever known program wrote it.

    Raises:
        SequenceError: missing, damaged, without entries, or of a camera that cannot be used.
    """
    return read_entries(path)


def number_entry(path: Path, settings: dict[str, Any], key: str) -> float:
    """A finite number. Raises SequenceError if it is none or missing."""
    if key not in settings:
        raise SequenceError(f"{path}: entry '{key}' is missing")
    value = settings[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < CalibrationTuning.max_number:
        raise SequenceError(f"{path}: expected a number for '{key}', found '{value}'")
    return float(value)


def camera_entry(path: Path, settings: dict[str, Any]) -> Camera:
    """Entries width, height, fx, fy, cx, cy as a camera. Raises SequenceError if they are none."""
    width, height, fx, fy, cx, cy = (
        number_entry(path, settings, key) for key in ("width", "height", "fx", "fy", "cx", "cy")
    )
    if abs(cx) > CalibrationTuning.max_centre * abs(width) or abs(cy) > CalibrationTuning.max_centre * abs(height):
        raise SequenceError(f"{path}: impossible principal point {cx:g}, {cy:g} of an image of {width:g}x{height:g}")
    return camera_of(path, width, height, fx, fy, cx, cy)


def camera_or_calibration(path: Path, settings: dict[str, Any]) -> tuple[Camera | None, Calibration | None]:
    """The camera, or where the file tells no size (K.txt) its (fx, fy, cx, cy) for images as they are.

    Raises:
        SequenceError: the entries are no camera.
    """
    if "width" in settings or "height" in settings or not {"fx", "fy", "cx", "cy"} <= settings.keys():
        return camera_entry(path, settings), None
    fx, fy, cx, cy = (number_entry(path, settings, key) for key in ("fx", "fy", "cx", "cy"))
    check_intrinsics(path, fx, fy, cx, cy)
    return None, (fx, fy, cx, cy)


def distortion_entry(path: Path, settings: dict[str, Any]) -> tuple[np.ndarray | None, bool]:
    """Coefficients float64 [4, 5, 8, 12 or 14] or None, and whether they are of the fisheye model.

    Raises:
        SequenceError: another number of them, or a model that cannot be undone.
    """
    model, distortion = settings.get("distortion_model", "opencv"), settings.get("distortion")
    if distortion is None:
        return None, False
    values = distortion if isinstance(distortion, list) else [None]
    if not all(
        isinstance(v, (int, float)) and not isinstance(v, bool) and abs(v) < CalibrationTuning.max_number
        for v in values
    ):
        raise SequenceError(f"{path}: expected numbers for 'distortion', found '{distortion}'")
    return distortion_of(path, str(model), np.array(values, float))


def depth_camera_entry(path: Path, settings: Any) -> DepthCamera:
    """A depth camera of its entries.

    Raises:
        SequenceError: an entry is missing, or T_color_depth is no rigid transform.
    """
    if not isinstance(settings, dict):
        raise SequenceError(f"{path}: expected entries width, height, fx, fy, cx, cy, T_color_depth of a depth camera")
    if "T_color_depth" not in settings:
        raise SequenceError(
            f"{path}: entry 'T_color_depth' is missing: the 16 numbers, row by row, that bring points of the depth "
            "camera into the colour camera's frame (metres)"
        )
    T = transform_entry(str(path), settings, "T_color_depth")
    distortion, fisheye = distortion_entry(path, settings)
    return DepthCamera(camera_entry(path, settings), T, distortion, fisheye)


def transform_entry(place: str, settings: dict[str, Any], key: str) -> np.ndarray:
    """A rigid transform, float64 [4, 4], of 16 numbers row by row, or of four rows.

    Args:
        place: of the entries, for messages.
        settings: them.
        key: name of the entry.

    Raises:
        SequenceError: it is missing, or no rigid transform.
    """
    if key not in settings:
        raise SequenceError(f"{place}: entry '{key}' is missing")
    try:
        T = np.array(settings[key], float).reshape(-1)
    except (TypeError, ValueError):
        T = np.zeros(0)
    if T.size != 16 or not np.isfinite(T).all() or not is_valid_pose(T.reshape(4, 4)):
        raise SequenceError(f"{place}: expected '{key}' to be the 16 numbers of a rigid transform, row by row")
    return T.reshape(4, 4)


def use_depth_camera(recording: Recording, path: Path) -> None:
    """Lets the depth images of a recording be registered by the calibration in a file.

    Raises:
        SequenceError: the file is missing or does not follow the format above.
    """
    settings = read_calibration(path)
    recording.depth_camera, recording.depth_calibration = depth_camera_entry(path, settings), None
    color = settings.get("color")
    if color is not None:
        if not isinstance(color, dict):
            raise SequenceError(f"{path}: expected 'color' to hold width, height, fx, fy, cx, cy")
        recording.camera, recording.calibration = camera_entry(path, color), None
        recording.distortion, recording.fisheye = distortion_entry(path, color)
