# SPDX-License-Identifier: Apache-2.0
"""Arrays that go into the compiled core's occupancy functions and come out of them."""

from __future__ import annotations

import ctypes

import numpy as np

from ggslam.errors import InputError
from ggslam.native.loader import load_library

LEAF = np.dtype([("centre", np.float32, 3), ("size", np.float32), ("log_odds", np.float32)])


def output_bytes(handle: int, size: int) -> bytes:
    """A copy of the `size` bytes that the last call left with the map."""
    return ctypes.string_at(load_library().ggslam_occupancy_output(handle), size) if size else b""


def contiguous_points(points: np.ndarray) -> np.ndarray:
    """Points as float32 [N, 3], C order.

    Raises:
        InputError: another shape.
    """
    points = np.ascontiguousarray(points, np.float32)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points: expected shape [N, 3], found {list(points.shape)}")
    return points
