# SPDX-License-Identifier: Apache-2.0
"""Intrinsics given by the user instead of the recording's own."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Final

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.calibration import camera_or_calibration, distortion_entry, number_entry, read_calibration
from ggslam.sequences.json_files import check_intrinsics
from ggslam.sequences.recording import Calibration, OwnCamera, Recording

COUNTS: Final = (0, 4, 5, 8)
"""Numbers of distortion coefficients of OpenCV's models; fewer are filled up with zeros."""


def read_own_camera(camera: Path | None, intrinsics: str | None) -> OwnCamera | None:
    """The camera that a file or a line of numbers tells; None without either.

    Args:
        camera: file as camera.yaml of a plain folder, or of another program (`camera_files`); its depth scale may be
            left out.
        intrinsics: "fx fy cx cy", then up to 8 coefficients of distortion in OpenCV's order, of the colour image as
            stored.

    Raises:
        SequenceError: both are given, or what is given is no camera.
    """
    if camera is not None and intrinsics is not None:
        raise SequenceError("`camera` and `intrinsics`: expected one of them, found both")
    if camera is not None:
        return _camera_of_file(camera)
    if intrinsics is None:
        return None
    calibration, coefficients = _numbers_of(intrinsics)
    return OwnCamera("`intrinsics`", None, calibration, coefficients, False, None)


def _camera_of_file(path: Path) -> OwnCamera:
    settings = read_calibration(path)
    if "T_color_depth" in settings:
        raise SequenceError(
            f"{path}: is the calibration of a depth camera (it holds T_color_depth), not of the colour camera: give it "
            "as `depth_camera`"
        )
    distortion, fisheye = distortion_entry(path, settings)
    scale = number_entry(path, settings, "depth_scale") if "depth_scale" in settings else None
    camera, calibration = camera_or_calibration(path, settings)
    return OwnCamera(f"`camera` {path}", camera, calibration, distortion, fisheye, scale)


def _numbers_of(intrinsics: str) -> tuple[Calibration, np.ndarray | None]:
    try:
        numbers = [float(word) for word in intrinsics.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if not 4 <= len(numbers) <= 4 + COUNTS[-1] or not np.isfinite(numbers).all():
        wanted = "4 numbers 'fx fy cx cy', or these and up to 8 of distortion"
        raise SequenceError(f"`intrinsics`: expected {wanted}, found '{intrinsics[:80]}'")
    fx, fy, cx, cy, *coefficients = numbers
    check_intrinsics("`intrinsics`", fx, fy, cx, cy)
    count = next(count for count in COUNTS if count >= len(coefficients))
    padded = np.array(coefficients + [0.0] * (count - len(coefficients)))
    return (fx, fy, cx, cy), padded if count else None


def use_own_camera(recording: Recording, own: OwnCamera, scale_told: bool) -> None:
    """Takes a camera for the colour images of a recording, and its depth scale if it tells one; `scale_told`: a user
    tells the scale besides."""
    recording.camera, recording.calibration = own.camera, own.calibration
    recording.distortion, recording.fisheye = own.distortion, own.fisheye
    recording.camera_source = own.source
    if own.depth_scale is not None and not scale_told:
        _take_scale(recording, own.source, own.depth_scale)
    if any(entry.camera is not None for entry in recording.files):
        recording.files = [dataclasses.replace(entry, camera=None) for entry in recording.files]


def _take_scale(recording: Recording, source: str, scale: float) -> None:
    """The depth scale of a camera file; where the recording tells its own unit, the two may not go together."""
    told = recording.depth_scale
    if not np.isclose(told, scale, rtol=1e-3):
        recording.warnings.append(
            f"{source} gives {scale:g} depth units per metre, the recording ({recording.format}) {told:g}: {scale:g} "
            "is used; `depth_scale` decides"
        )
    recording.depth_scale = scale
