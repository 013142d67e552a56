# SPDX-License-Identifier: Apache-2.0
"""What programs call their models of lens distortion, and which of them can be undone."""

from __future__ import annotations

from typing import Final

import numpy as np

from ggslam.errors import SequenceError

OPENCV_NAMES = ("opencv", "plumb_bob", "rational_polynomial", "radtan", "radial-tangential", "pinhole", "perspective")
FISHEYE_NAMES = ("fisheye", "equidistant", "kannalabrandt8", "kannala_brandt", "opencv_fisheye")
NO_DISTORTION = ("none", "no_distortion", "rectified")
COUNTS: Final = (4, 5, 8, 12, 14)
"""Numbers of coefficients that OpenCV takes: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [two tilts]]]]."""


def distortion_of(place: object, model: str, values: np.ndarray) -> tuple[np.ndarray | None, bool]:
    """Coefficients that OpenCV undoes, float64 [4, 5, 8, 12 or 14] or None, and whether they are of its fisheye model.

    Args:
        place: of the calibration, for messages.
        model: its name there, in any case.
        values: coefficients float64 [n], as stored.

    Raises:
        SequenceError: they distort, and the model is another one or has another number of them.
    """
    if not values.size or not np.any(values):  # whatever the model, nothing is distorted
        return None, False
    name = model.lower()
    fisheye = name in FISHEYE_NAMES
    if name and not fisheye and name not in OPENCV_NAMES:
        known = f"{', '.join(OPENCV_NAMES)} and {', '.join(FISHEYE_NAMES)}"
        raise SequenceError(f"{place}: lens distortion of the model '{model}' cannot be undone; known are {known}")
    counts = (4,) if fisheye else COUNTS
    if len(values) not in counts or not np.isfinite(values).all():
        wanted = "4" if fisheye else "4, 5, 8, 12 or 14"
        found = f"found {len(values)}" if np.isfinite(values).all() else "found what is no number"
        raise SequenceError(f"{place}: expected {wanted} coefficients of '{model}' for 'distortion', {found}")
    return values, fisheye
