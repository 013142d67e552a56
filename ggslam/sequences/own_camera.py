# SPDX-License-Identifier: Apache-2.0
"""Intrinsics that a user gives, instead of those that a recording or its format tells."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from ggslam.errors import SequenceError
from ggslam.sequences.calibration import camera_entry, distortion_entry, number_entry, read_calibration
from ggslam.sequences.json_files import camera_of
from ggslam.sequences.recording import Calibration, OwnCamera, Recording

COUNTS = (0, 4, 5, 8)
"""Of coefficients of distortion that OpenCV takes; fewer are filled up with zeros."""


def read_own_camera(camera: Path | None, intrinsics: str | None) -> OwnCamera | None:
    """The camera that a file or a line of numbers tells; None without either.

    Args:
        camera: YAML file as camera.yaml of a plain folder; its depth scale may be left out.
        intrinsics: "fx fy cx cy", then up to 8 coefficients of distortion in OpenCV's order, of the colour image as
            stored.

    Raises:
        SequenceError: both are given, or what is given is no camera.
    """
    if camera is not None and intrinsics is not None:
        raise SequenceError("`camera` and `intrinsics`: expected one of them, found both")
    if camera is not None:
        settings = read_calibration(camera)
        distortion, fisheye = distortion_entry(camera, settings)
        scale = number_entry(camera, settings, "depth_scale") if "depth_scale" in settings else None
        return OwnCamera(f"`camera` {camera}", camera_entry(camera, settings), None, distortion, fisheye, scale)
    if intrinsics is None:
        return None
    calibration, coefficients = _numbers_of(intrinsics)
    return OwnCamera("`intrinsics`", None, calibration, coefficients, False, None)


def _numbers_of(intrinsics: str) -> tuple[Calibration, np.ndarray | None]:
    try:
        numbers = [float(word) for word in intrinsics.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if not 4 <= len(numbers) <= 4 + COUNTS[-1] or not np.isfinite(numbers).all():
        wanted = "4 numbers 'fx fy cx cy', or these and up to 8 of distortion"
        raise SequenceError(f"`intrinsics`: expected {wanted}, found '{intrinsics[:80]}'")
    fx, fy, cx, cy, *coefficients = numbers
    camera_of("`intrinsics`", 1, 1, fx, fy, cx, cy)
    count = next(count for count in COUNTS if count >= len(coefficients))
    padded = np.array(coefficients + [0.0] * (count - len(coefficients)))
    return (fx, fy, cx, cy), padded if count else None


def use_own_camera(recording: Recording, own: OwnCamera) -> None:
    """Takes a camera for the colour images of a recording, and its depth scale if it tells one."""
    recording.camera, recording.calibration = own.camera, own.calibration
    recording.distortion, recording.fisheye = own.distortion, own.fisheye
    recording.camera_source = own.source
    if own.depth_scale is not None:
        recording.depth_scale = own.depth_scale
    if any(entry.camera is not None for entry in recording.files):
        recording.files = [dataclasses.replace(entry, camera=None) for entry in recording.files]
