# SPDX-License-Identifier: Apache-2.0
"""Checks that a frame is as its recording promises."""

from __future__ import annotations

import math

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.camera import Camera
from ggslam.scene.frame import Frame
from ggslam.system.medians import median
from ggslam.system.tuning import Tuning


class FrameCheckTuning(Tuning):
    """When depth has the wrong unit."""

    max_median_m = 100.0
    """Largest median depth in metres. Millimetres or centimetres give larger numbers."""
    max_median_cm = 1000.0
    """Largest median depth in centimetres. Larger numbers are millimetres: half of a room is closer than 10 m."""


def wrong_unit(depth: np.ndarray) -> str:
    """What to say of a depth image [H, W] that cannot be in metres; empty if it can. Looks at every eighth pixel and
    row."""
    found = _median_depth(depth)
    if found <= FrameCheckTuning.max_median_m:
        return ""
    if found <= FrameCheckTuning.max_median_cm:
        return (
            f"depth looks like millimetres or centimetres (median {found:.0f}), expected metres: divide millimetres "
            "by 1000, centimetres by 100"
        )
    return f"depth looks like millimetres (median {found:.0f}), expected metres: divide it by 1000"


def _median_depth(depth: np.ndarray) -> float:
    """Of the depths that are known, 0 if none is."""
    seen = depth[::8, ::8]
    seen = seen[(seen > 0) & np.isfinite(seen)]
    return median(seen) if len(seen) else 0.0


def _check_depth(frame: Frame) -> None:
    if unit := wrong_unit(frame.depth):
        raise SequenceError(f"frame {frame.source_index}: {unit}")
    # Of a NaN among them, the least and the greatest are NaN.
    if not (np.minimum.reduce(frame.depth, axis=None) >= 0 and np.maximum.reduce(frame.depth, axis=None) < np.inf):
        raise SequenceError(f"frame {frame.source_index}: depth has negative, infinite or NaN values; 0 means none")


def check_frame(frame: Frame, camera: Camera) -> None:
    """Raises SequenceError unless the frame is of the camera and what `Frame` promises: images of its size, of the
    right types and in metres; a finite time; and no pose or a finite one [4, 4]."""
    if not isinstance(frame.color, np.ndarray) or not isinstance(frame.depth, np.ndarray):
        name, image = ("depth", frame.depth) if isinstance(frame.color, np.ndarray) else ("colour", frame.color)
        raise SequenceError(f"frame {frame.source_index}: {name} is {type(image).__name__}, expected a numpy array")
    size = (camera.height, camera.width)
    for name, image, shape, kind in (("colour", frame.color, (*size, 3), "u1"), ("depth", frame.depth, size, "f4")):
        if image.shape[:2] != size:
            found = "x".join(str(n) for n in image.shape[1::-1])
            expected = f"{camera.width}x{camera.height}"
            raise SequenceError(f"frame {frame.source_index}: {name} is {found}, expected {expected}")
        if image.shape != shape or image.dtype != np.dtype(kind):
            found = f"{image.dtype} {list(image.shape)}"
            raise SequenceError(
                f"frame {frame.source_index}: {name} is {found}, expected {np.dtype(kind)} {list(shape)}"
            )
    if frame.camera is not camera and frame.camera != camera:
        raise SequenceError(f"frame {frame.source_index}: it is of {frame.camera}, expected {camera}")
    # Numbers are in the order of their bits; those of what is negative, infinite or NaN are greater.
    usual = np.float32(FrameCheckTuning.max_median_m).view(np.uint32)
    if np.maximum.reduce(frame.depth.view(np.uint32), axis=None) > usual:
        _check_depth(frame)
    if not math.isfinite(frame.timestamp):
        raise SequenceError(f"frame {frame.source_index}: its time is {frame.timestamp}, expected seconds")
    if frame.T_world_camera is None:
        return
    T = np.asarray(frame.T_world_camera)
    if T.shape != (4, 4) or not np.logical_and.reduce(np.isfinite(T), axis=None):
        found = "numbers that are not finite" if T.shape == (4, 4) else f"shape {list(T.shape)}"
        raise SequenceError(
            f"frame {frame.source_index}: T_world_camera has {found}, expected a finite 4x4 matrix or None"
        )
