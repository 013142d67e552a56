# SPDX-License-Identifier: Apache-2.0
"""Colours as glTF stores them at vertices: linear light, while images, PLY files and our maps hold sRGB numbers.

The curve is that of IEC 61966-2-1. COLOR_0 gets 16 bits: of 8 linear ones the darkest tenth of the sRGB numbers would
share four.
"""

from __future__ import annotations

import numpy as np

COLOR_TYPE = np.dtype("<u2")
"""Of the numbers of COLOR_0; normalised, 65535 is 1."""


def linear_light(encoded: np.ndarray) -> np.ndarray:
    """Light of sRGB numbers, 0 to 1 both."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def vertex_colors(encoded: np.ndarray, opacity: np.ndarray | float = 1.0) -> np.ndarray:
    """COLOR_0, uint16 [N, 4], of sRGB numbers [N, 3] and opacities [N], 0 to 1 both."""
    alpha = np.broadcast_to(np.asarray(opacity, np.float64).reshape(-1, 1), (len(encoded), 1))
    return np.rint(65535 * np.hstack([linear_light(np.asarray(encoded, np.float64)), alpha])).astype(COLOR_TYPE)
