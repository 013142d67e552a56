# SPDX-License-Identifier: Apache-2.0
"""Intrinsics as a matrix K, written row by row or column by column."""

from __future__ import annotations

from typing import Any

import numpy as np

from ggslam.errors import SequenceError
from ggslam.system.tuning import Tuning


class MatrixTuning(Tuning):
    """When a camera matrix is a pinhole camera."""

    max_skew = 1e-3
    """Largest skew that rounding may leave, as a share of the focal length."""


def matrix_numbers(place: object, value: Any) -> np.ndarray:
    """float64 [n] of a flat list, of rows, or of OpenCV's and ROS's {rows, cols, data}.

    Raises:
        SequenceError: it is none of them, or holds what is no finite number, or not rows x cols of them.
    """
    data = value.get("data") if isinstance(value, dict) else value
    try:
        numbers = np.asarray(data, float).reshape(-1)
    except (TypeError, ValueError):
        numbers = np.full(1, np.nan)
    if not np.isfinite(numbers).all():
        raise SequenceError(f"{place}: expected a matrix of numbers, found '{str(value)[:60]}'")
    if isinstance(value, dict) and {"rows", "cols"} <= value.keys():
        rows, columns = value["rows"], value["cols"]
        if not isinstance(rows, int) or not isinstance(columns, int) or rows * columns != numbers.size:
            raise SequenceError(f"{place}: expected {rows} x {columns} numbers, found {numbers.size}")
    return numbers


def intrinsics_of_matrix(place: object, numbers: np.ndarray) -> dict[str, float]:
    """Entries fx, fy, cx, cy of the 9, 12 or 16 numbers of K (3x3, 3x4, 4x4). Which of rows and columns comes first is
    told by where the zeros are: the last row of K is 0 0 1.

    Raises:
        SequenceError: it is no K of a camera with square rows and columns of pixels (skew), or of no camera.
    """
    if numbers.size not in (9, 12, 16):
        raise SequenceError(f"{place}: expected the 9 numbers of a camera matrix, found {numbers.size}")
    K = numbers.reshape({9: (3, 3), 12: (3, 4), 16: (4, 4)}[numbers.size])[:3, :3]
    if not K[:2, 2].any() and K[2, :2].any():
        K = K.T
    fx, fy, cx, cy = (float(K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if not (fx > 0 and fy > 0):
        raise SequenceError(f"{place}: expected positive focal lengths, found fx {fx:g}, fy {fy:g}")
    if K[2].tolist() != [0, 0, 1] or K[1, 0] != 0:
        raise SequenceError(f"{place}: expected a camera matrix [fx 0 cx; 0 fy cy; 0 0 1], found {K.tolist()}")
    if abs(K[0, 1]) > MatrixTuning.max_skew * fx:
        raise SequenceError(f"{place}: a camera matrix with skew ({K[0, 1]:g}) is not supported")
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
